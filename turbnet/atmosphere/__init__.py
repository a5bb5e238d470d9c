"""What the air does to light, in numbers only."""
