"""Networks as pure modules."""
