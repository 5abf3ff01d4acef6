"""What the verbs write: lines for the terminal, and checked files and folders."""
