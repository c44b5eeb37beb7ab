"""Solvers: progressive refinement, the direct judge, and the solution that both return."""
