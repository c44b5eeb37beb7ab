"""Geometry: polygons, planes, curved surfaces cut into facets, and a scene as flat arrays for kernels."""
