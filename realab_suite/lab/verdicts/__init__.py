"""Verdicts on designs, by hidden results: stakes, hack rates, labels."""
