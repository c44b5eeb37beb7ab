"""Sampling: point sequences, and the warps that carry them to lights, hemispheres and lenses."""
