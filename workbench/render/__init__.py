"""Pictures: cameras, shading, ray casting and tracing, adaptive sampling and image files."""
