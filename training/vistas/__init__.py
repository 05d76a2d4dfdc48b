"""Drawn scenes with what fills them: rooms, kitchens, shops, corridors, houses, streets and town fronts, with relief,
plants, people and cars, uneven light, and what lenses and cameras add. Every straight edge is exactly straight.

They stand beside the plain blocks of `training.scenes`. Coordinates of the world: metres, x right, y up from the floor,
z ahead; the camera stands at x = z = 0, upright.
"""

from training.vistas.scene import draw_scene

__all__ = ["draw_scene"]
