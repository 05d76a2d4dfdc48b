"""Scenes as SVG: pictures embedded, curves and text as what they are."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from xml.sax.saxutils import escape

import cv2
import numpy as np

from unbend_service.adapters.drawing.rasters import HALO_OPACITY, halo_width_px
from unbend_service.adapters.drawing.scene import Block, Colour, Label, Placed, Raster, Scene, Strokes
from unbend_service.domain.maps import Float64


def vectorised(scene: Scene) -> str:
    """One SVG document; its unit is the pixel of the scene."""
    return "\n".join(_svg(scene, "")) + "\n"


def _svg(scene: Scene, place: str) -> Iterator[str]:
    size = f'width="{scene.width}" height="{scene.height}" viewBox="0 0 {scene.width} {scene.height}"'
    yield f'<svg xmlns="http://www.w3.org/2000/svg" {place}{size} font-family="Helvetica, Arial, sans-serif">'
    if not place:
        yield f'<rect width="{scene.width}" height="{scene.height}" fill="#fff"/>'
    for item in scene.items:
        match item:
            case Raster():
                yield _image(item)
            case Strokes():
                yield from _strokes(item)
            case Block():
                yield (
                    f'<rect x="{item.left:g}" y="{item.top:g}" width="{item.width:g}" height="{item.height:g}" '
                    f'fill="{_hex(item.colour)}" fill-opacity="{item.opacity:g}"/>'
                )
            case Label():
                yield (
                    f'<text x="{item.x:.1f}" y="{item.y:.1f}" font-size="{item.size_px:.1f}" '
                    f'fill="{_hex(item.colour)}" text-anchor="{item.anchor}">{escape(item.text)}</text>'
                )
            case Placed():
                yield from _svg(item.scene, f'x="{item.left:g}" y="{item.top:g}" ')
    yield "</svg>"


def _image(raster: Raster) -> str:
    height, width = raster.pixels.shape[:2]
    encoded = base64.b64encode(cv2.imencode(".png", raster.pixels[..., ::-1])[1].tobytes()).decode()
    return (
        f'<image x="{raster.left:g}" y="{raster.top:g}" width="{width}" height="{height}" '
        f'href="data:image/png;base64,{encoded}"/>'
    )


def _strokes(strokes: Strokes) -> Iterator[str]:
    families = [("".join(_polyline(curve) for curve in curves), colour) for curves, colour in strokes.families]
    joints = 'fill="none" stroke-linecap="round" stroke-linejoin="round"'
    if strokes.halo:
        everything = "".join(lines for lines, _ in families)
        width = halo_width_px(strokes.width_px)
        yield f'<g {joints} stroke="#000" opacity="{HALO_OPACITY}" stroke-width="{width}">{everything}</g>'
    for lines, colour in families:
        yield f'<g {joints} stroke="{_hex(colour)}" stroke-width="{strokes.width_px:g}">{lines}</g>'


def _polyline(curve: Float64) -> str:
    points = " ".join(f"{x:.2f},{y:.2f}" for x, y in np.asarray(curve))
    return f'<polyline points="{points}"/>'


def _hex(colour: Colour) -> str:
    return "#{:02x}{:02x}{:02x}".format(*colour)
