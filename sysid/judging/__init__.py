"""How far to trust a result: residual tests, verdicts, comparison of structures."""
