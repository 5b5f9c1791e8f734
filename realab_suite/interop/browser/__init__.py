"""Worlds in a browser: 3D recordings, and pages for people."""
