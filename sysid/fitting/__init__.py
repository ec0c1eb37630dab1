"""From errors to better parameters: the objective, its quadratic, local refinement."""
