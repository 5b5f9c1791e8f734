"""Writes the textures of `labmaze.assets`: tiles of one colour, and skies."""

import pathlib
import re

import numpy as np
from PIL import Image

_FOLDER = pathlib.Path(__file__).parent / 'labmaze' / 'assets'
_SIZE = 64
_COLOURS = {
    'blue': (60, 90, 190), 'cerise': (200, 50, 110), 'cyan': (60, 180, 190),
    'dblue': (35, 50, 120), 'dorange': (190, 90, 30), 'gray': (130, 130, 130),
    'green': (60, 150, 70), 'lgreen': (130, 200, 110), 'orange': (220, 130, 50),
    'purple': (130, 70, 170), 'red': (190, 50, 50), 'yellow': (210, 190, 60),
}  # fmt: skip
_SKIES = {'sky_01': 230, 'sky_02': 190, 'sky_03': 150}


def _tile(name: str, share: float) -> np.ndarray:
  """Returns a tile with a darker edge."""
  colour = np.array(_COLOURS[re.sub('_bright|_team', '', name)]) * share
  colour += 0.35 * (255 - colour) * ('_bright' in name)
  tile = np.tile(colour, (_SIZE, _SIZE, 1))
  tile[[0, -1]] *= 0.7
  tile[:, [0, -1]] *= 0.7
  return tile


def _write(name: str, pixels: np.ndarray) -> None:
  image = Image.fromarray(pixels.round().astype(np.uint8))
  image.save(_FOLDER / f'{name}.png', optimize=True)


def main() -> None:
  """Writes the texture of every colour that a style names."""
  text = (_FOLDER / '__init__.py').read_text()
  walls, floors = text.split('_COLOURS_OF_FLOORS = ')
  for kind, part, share in (('wall', walls, 1.0), ('floor', floors, 0.8)):
    for colours in re.findall(r"'style_\d+': '(.*)'", part):
      for name in colours.split():
        _write(f'{kind}_{name}', _tile(name, share))
  for name, blue in _SKIES.items():
    _write(name, np.tile([blue - 60.0, blue - 20.0, blue], (_SIZE, _SIZE, 1)))


if __name__ == '__main__':
  main()
