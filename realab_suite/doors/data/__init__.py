"""Datasets of recorded episodes, in which agents and evaluators have their own.

They require the extra `data`.
"""
