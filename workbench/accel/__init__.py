"""Accelerators: the closest hit and whether anything blocks, by brute force, grids, box trees and Embree."""
