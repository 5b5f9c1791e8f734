"""The report of a sweep: what it shows, and in which words and pictures."""
