"""Text for people: errors, checked arguments, numbers and shell commands."""
