"""Reports: error against a reference, and error against seconds."""
