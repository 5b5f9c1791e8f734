"""Datasets of recorded episodes: the agent's data and the evaluator's apart.

The needed packages are those of the extra `data`.
"""
