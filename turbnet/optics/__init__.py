"""Light in still air."""
