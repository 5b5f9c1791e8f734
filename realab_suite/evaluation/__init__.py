"""The evaluator's side: the only reader of the true reward."""
