"""Plain textures, one file for each colour."""

import os
from typing import NamedTuple, final

_FOLDER = os.path.dirname(os.path.abspath(__file__))

SKY_STYLES = ('sky_01', 'sky_02', 'sky_03')
"""Names of skies."""

_COLOURS_OF_WALLS = {
    'style_01': 'blue cerise green_bright green purple red_bright red yellow',
    'style_02': 'blue_bright blue dblue lgreen purple yellow_bright yellow',
    'style_03': 'blue cyan gray_bright gray orange_bright orange purple',
    'style_04': 'cerise green_bright green purple red_bright red',
    'style_05': 'red_bright red yellow_bright yellow',
}
_COLOURS_OF_FLOORS = {
    'style_01': 'blue_bright blue blue_team orange_bright orange red_team',
    'style_02': 'blue_bright blue green_bright green orange',
    'style_03': 'blue_bright blue green_bright green orange purple red',
    'style_04': 'blue_bright blue cyan dorange orange_bright orange',
    'style_05': 'blue_bright blue orange_bright orange',
}

MAZE_STYLES = tuple(_COLOURS_OF_WALLS)
"""Names of sets of textures for walls and floors."""


@final
class SkyBox(NamedTuple):
  """Paths of the six sides of a sky."""

  left: str
  right: str
  up: str
  down: str
  front: str
  back: str


def _check(style: str, allowed: tuple[str, ...]) -> None:
  if style not in allowed:
    raise ValueError(f'style: {style!r}; must be one of {allowed}')


def _path(stem: str) -> str:
  return os.path.join(_FOLDER, f'{stem}.png')


def get_sky_texture_paths(style: str) -> SkyBox:
  """Returns the paths of a sky, whose sides look alike.

  Raises:
    ValueError: If there is no such style.
  """
  _check(style, SKY_STYLES)
  return SkyBox(*[_path(style)] * len(SkyBox._fields))


def get_wall_texture_paths(style: str) -> dict[str, str]:
  """Returns the paths of the textures of walls, by colour.

  Raises:
    ValueError: If there is no such style.
  """
  _check(style, MAZE_STYLES)
  colours = _COLOURS_OF_WALLS[style].split()
  return {colour: _path(f'wall_{colour}') for colour in colours}


def get_floor_texture_paths(style: str) -> dict[str, str]:
  """Returns the paths of the textures of floors, by colour.

  Raises:
    ValueError: If there is no such style.
  """
  _check(style, MAZE_STYLES)
  colours = _COLOURS_OF_FLOORS[style].split()
  return {colour: _path(f'floor_{colour}') for colour in colours}
