"""A result as rows, and what renders them: page, LaTeX table, figures, document."""
