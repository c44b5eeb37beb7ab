"""Form factors: closed forms, bundles from receivers toward a shooter, and whole matrices."""
