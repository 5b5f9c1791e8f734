"""Launchers, on absl flags."""
