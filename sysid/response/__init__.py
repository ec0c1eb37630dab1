"""What a model does around an operating point: Jacobians, linear models, frequency responses."""
