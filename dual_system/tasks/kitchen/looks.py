"""Materials of the bay: robosuite's textures (MIT licence, read from its installed files) and plain colours.

All plain colours are swatches of one texture. So everything plain of a body is one mesh, which a software renderer
draws in one call: it pays for calls (0.017 ms each), hardly for faces.
"""

from __future__ import annotations

import mujoco
import numpy as np

from dual_system.tasks.geometry import Array
from dual_system.tasks.kitchen.plan import Finish
from dual_system.tasks.panda_model import robosuite_assets

PAINT = "paint"
WALLS = ("cream-plaster", "white-plaster", "gray-plaster", "light-gray-plaster")
FLOORS = ("light-gray-floor-tile", "wood-tiles", "gray-woodgrain")
TOPS = ("ceramic", "light-gray-plaster", "white-plaster", "light-wood")
WOODS = ("dark-wood", "light-wood", "gray-woodgrain", "blue-wood", "green-wood")

COLORS: dict[str, tuple[int, int, int]] = {
    "white": (245, 245, 242),
    "cream": (236, 224, 196),
    "silver": (190, 194, 198),
    "gray": (128, 130, 133),
    "iron": (74, 76, 80),
    "black": (34, 34, 37),
    "glass": (52, 62, 74),
    "red": (198, 40, 40),
    "dark red": (128, 24, 34),
    "orange": (238, 128, 28),
    "yellow": (242, 206, 40),
    "lime": (172, 206, 60),
    "green": (70, 150, 62),
    "dark green": (32, 92, 52),
    "teal": (42, 150, 150),
    "blue": (44, 96, 190),
    "navy": (30, 44, 104),
    "purple": (116, 62, 150),
    "pink": (232, 142, 160),
    "brown": (122, 78, 44),
    "tan": (200, 160, 108),
    "crust": (182, 120, 58),
}
_SWATCH_PX = 16
_REPEAT_M = {"wall": 1.2, "floor": 1.0, "top": 0.8, "wood": 0.7}  # side of the square that a texture covers
TEXTURED = tuple(_REPEAT_M)
_SHADE = {  # brings textures of very different brightness near each other
    "dark-wood": 1.0,
    "gray-woodgrain": 0.9,
    "wood-tiles": 0.9,
}


def add_materials(spec: mujoco.MjSpec, finish: Finish) -> None:
    """Adds the four textured materials of a finish and the palette."""
    for material in TEXTURED:
        file = getattr(finish, material)
        texture = spec.add_texture(name=material, type=mujoco.mjtTexture.mjTEXTURE_2D)
        texture.file = str(robosuite_assets() / "textures" / f"{file}.png")
        shade = _SHADE.get(file, 1.0)
        added = spec.add_material(name=material, specular=0.0, rgba=[shade, shade, shade, 1.0])
        added.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = material
    swatches = np.repeat(np.array(list(COLORS.values()), dtype=np.uint8), _SWATCH_PX, axis=0)
    palette = spec.add_texture(
        name=PAINT, type=mujoco.mjtTexture.mjTEXTURE_2D, width=len(swatches), height=_SWATCH_PX, nchannel=3
    )
    palette.data = np.broadcast_to(swatches, (_SWATCH_PX, *swatches.shape)).tobytes()
    added = spec.add_material(name=PAINT, specular=0.2, shininess=0.3)
    added.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = PAINT


def material_of(look: str) -> str:
    """Returns the material of a look: itself if it is a textured one, else the palette. Raises KeyError."""
    if look not in _REPEAT_M and look not in COLORS:
        raise KeyError(f"unknown look {look!r}; expected one of {', '.join([*_REPEAT_M, *COLORS])}")
    return look if look in _REPEAT_M else PAINT


def texture_points(look: str, uv_m: Array) -> Array:
    """Returns texture coordinates (n, 2) of points (n, 2) on a surface in metres: tiled, or all on one swatch."""
    if look in _REPEAT_M:
        return uv_m / _REPEAT_M[look]
    swatch = ((list(COLORS).index(look) + 0.5) / len(COLORS), 0.5)
    return np.tile(swatch, (len(uv_m), 1))
