"""An author's register: two beads beside a base block.

It is written as an author would write it, from the documentation, and has three
blocks and two ports: each bead stores a number as its distance from the base
block, so moving the base block changes both.
"""

from typing import Literal

import numpy as np

from realab_suite.entities import registers
from realab_suite.entities.registers import moves
from realab_suite.feedback import providers
from realab_suite.feedback import register_kinds

NAME = 'two_beads'


@register_kinds.REGISTER_KINDS.add(NAME)
class Abacus(registers.Register):
  """Stores two numbers as the distances of two beads from a base block."""

  PORTS = 'left', 'right'

  def _build_blocks(self):
    base = self._add_block('base', 'base_block', (0.0, 0.0), (-1.0, 0.0))
    self._starts = [(0.0, 0.25, 0.0), (0.0, -0.25, 0.0)]
    self._beads = [
        self._add_block(port, 'offset_block', start[:2], (1.0, 0.0), [port])
        for port, start in zip(self.PORTS, self._starts, strict=True)
    ]
    return [base, *self._beads]

  def _places(self, physics, value):
    origin = self._origin(physics)
    return [origin] + [
        moves.undisturbed(
            origin + start, value[..., i] * self._scale, bead.rest_height
        )
        for i, (start, bead) in enumerate(
            zip(self._starts, self._beads, strict=True)
        )
    ]

  def _put(self, physics, value, where=None):
    _, *places = self._places(physics, value)
    for bead, place in zip(self._beads, places, strict=True):
      bead.put(physics, place, where=where)

  def _shift(self, physics, value, where=None):
    start = self._origin(physics)[..., 0]
    placed = [
        moves.slide(physics, bead, start, value[..., i], self._scale, where)
        for i, bead in enumerate(self._beads)
    ]
    return np.stack(placed, axis=-1)

  def _read_blocks(self, physics):
    base, *beads = (block.along(physics) for block in self.blocks)
    return np.stack([bead - base for bead in beads], axis=-1) / self._scale

  def _permanent(self, physics):
    moved = self._origin(physics)[..., 0] - self.blocks[0].along(physics)
    return np.stack([moved, moved], axis=-1) / self._scale


@providers.PROVIDERS.add('copies_of_two')
class Copies(providers.Provider):
  """Writes what it reads, unless the first reading is above `silent_above`."""

  kind: Literal['copies_of_two'] = 'copies_of_two'
  silent_above: float = 1000.0
  omits: int = 0

  def initial_state(self, batch_shape):
    return np.zeros(batch_shape)

  def step(self, observation, readings, episode_start, key, state):
    speaks = np.array(readings[self.reads[0]] <= self.silent_above)
    pairs = [*zip(self.writes, self.reads, strict=True)]
    return {
        one: (readings[other], speaks) for one, other in pairs[self.omits :]
    }, state


_ABACUS = {'kind': NAME, 'range': [-5, 5], 'scale': 0.1}

DESIGN = {
    'schema': 1,
    'name': 'counted',
    'registers': {
        'seen': {**_ABACUS, 'role': 'meter', 'place': 'station_2'},
        'told': {**_ABACUS, 'role': 'feedback', 'place': 'station_1'},
    },
    'meters': [
        {'measures': 'score', 'writes': 'seen_left'},
        {
            'measures': {'kind': 'position', 'of': 'avatar', 'axis': 'x'},
            'writes': 'seen_right',
        },
    ],
    'providers': [
        {
            'kind': 'copies_of_two',
            'reads': ['seen_left', 'seen_right'],
            'writes': ['told_left', 'told_right'],
        }
    ],
    'learner': {'kind': 'policy_gradient', 'reward': 'told_left'},
}
