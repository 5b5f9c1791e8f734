"""Programs with command lines, one to a file."""
