"""Benefit of the layout of displays that corrects errors, beside plain tiles.

`python -m benchmarks.displays` stores every number of four bits in displays of
4 tiles (`gray`), of 12 tiles (`ecc`: three copies) and of 7 tiles with a
Hamming code, which the package does not offer. It counts how often the number
is still read correctly

- while a single tile is hidden, for each tile in turn;
- while an avatar stands at a random place in front: along the row, within 0.4 m
  of the tiles.

Tiles are 0.16 m wide and 0.18 m apart. Hamming words are written as the level
of a plain display of seven tiles that shows the same tiles.
"""

from typing import Any

import numpy as np

from realab_suite.engine import single_physics
from realab_suite.entities import arenas
from realab_suite.entities import avatars
from realab_suite.entities import registers

_SIZE, _GAP = 0.16, 0.02
_BITS, _NUM_PLACES, _SEED = 4, 400, 0
_DEPTH = 0.4
# Generator of the Hamming code of seven bits.
_GENERATOR = np.array([
    [1, 1, 1, 0, 0, 0, 0], [1, 0, 0, 1, 1, 0, 0],
    [0, 1, 0, 1, 0, 1, 0], [1, 1, 0, 1, 0, 0, 1],
])  # fmt: skip


def _tiles(kind: str) -> int:
  return {'plain': 4, 'three copies': 12, 'Hamming': 7}[kind]


def _words(kind: str) -> np.ndarray:
  """Returns the tiles of each number, `(numbers, tiles)` bool."""
  numbers = np.arange(2**_BITS)
  bits = numbers[:, np.newaxis] >> np.arange(_BITS) & 1
  if kind == 'Hamming':
    return bits @ _GENERATOR % 2 > 0
  return np.tile(bits, _tiles(kind) // _BITS) > 0


def _right(kind: str, words: np.ndarray, seen: np.ndarray) -> np.ndarray:
  """Returns which words are decoded correctly from what is seen of them."""
  if kind == 'Hamming':
    found = (seen[:, np.newaxis] != words).sum(axis=-1).argmin(axis=-1)
    return found == np.arange(len(words))
  copies = seen.reshape(len(seen), -1, _BITS)
  bits = 2 * copies.sum(axis=1) > copies.shape[1]
  return (bits == words[:, :_BITS]).all(axis=-1)


def singles(kind: str) -> float:
  """Returns the share of single hidden tiles with a correct reading."""
  words = _words(kind)
  tiles = np.eye(words.shape[1], dtype=bool)
  return float(np.mean([_right(kind, words, words | tile) for tile in tiles]))


def hidden_by_avatar(kind: str) -> np.ndarray:
  """Returns the tiles that an avatar hides, `(places, tiles)` bool."""
  number = _tiles(kind)
  arena, avatar = arenas.OpenRoom(), avatars.Avatar()
  display = registers.Display(
      'display', value_range=(0, 2**number - 1), tiles=number, block_size=_SIZE
  )
  display.attach_to(arena, (-1.0, 0.0))
  arena.attach(avatar)
  physics: Any = single_physics.ThinPhysics.from_mjcf_model(arena.mjcf_model)
  generator = np.random.default_rng(_SEED)
  with physics.reset_context():
    display.initialize_episode(physics, generator)
  display.write(physics, 0.0)
  width, nearest = _SIZE + _GAP, _SIZE / 2 + avatar.radius
  hidden = []
  for _ in range(_NUM_PLACES):
    x = -1.0 + width * generator.uniform(0.5, number + 0.5)
    y = nearest + generator.uniform(0.0, _DEPTH)
    avatar.place(physics, np.array([x, y]), 0.0)
    level = int(display.read(physics))
    # All tiles are lowered: those that look raised are hidden.
    hidden.append((level ^ level >> 1) >> np.arange(number) & 1)
  return np.array(hidden) > 0


def main() -> None:
  """Prints a table."""
  row = '{:14} {:>5} {:>12} {:>14} {:>12}'
  print(row.format('layout', 'tiles', 'single tile', 'hidden tiles', 'avatar'))
  for kind in ('plain', 'three copies', 'Hamming'):
    words, hidden = _words(kind), hidden_by_avatar(kind)
    right = np.mean([_right(kind, words, words | tiles) for tiles in hidden])
    print(
        row.format(
            kind,
            _tiles(kind),
            f'{singles(kind):.1%}',
            f'{hidden.sum(axis=1).mean():.1f} (0-{hidden.sum(axis=1).max()})',
            f'{right:.1%}',
        )
    )


if __name__ == '__main__':
  main()
