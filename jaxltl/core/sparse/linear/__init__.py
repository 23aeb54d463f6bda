"""Linear systems of policies: elimination, Gauss-Seidel, refinement, exact fractions."""
