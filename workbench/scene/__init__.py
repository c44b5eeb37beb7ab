"""Scenes: the records in ``model``, the readers of files beside it, and ``load.load`` that picks one."""
