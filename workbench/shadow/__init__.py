"""Shadows: how much of a light each receiver sees, by closed forms where they hold and rays elsewhere."""
