"""A page in a browser, for people who supervise."""
