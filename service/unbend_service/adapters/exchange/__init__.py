"""Grids in the files of other programs: one module a family, ``files`` chooses."""
