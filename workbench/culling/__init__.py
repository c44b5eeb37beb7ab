"""Cullers: what cannot block is set aside by planes and shafts, without rays and never wrongly."""
