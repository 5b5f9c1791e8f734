"""Designs in small worlds, and how agents in them are judged.

Stakes are measured as ever, but over fewer episodes.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
import contextlib
import functools
from typing import Any, NamedTuple, final

import numpy as np
import pandas as pd
import pytest

from realab_suite import policies
from realab_suite import worlds
from realab_suite.engine import batch_environment
from realab_suite.engine import environment
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import gains
from realab_suite.evaluation import results
from realab_suite.feedback import specs
from realab_suite.lab.audit import aiming
from realab_suite.lab.verdicts import judging
from realab_suite.lab.verdicts import obstacles
from realab_suite.lab.verdicts import stakes
from realab_suite.lab.verdicts import study
from tests.evaluation import rows
from tests.lab.verdicts import made_studies

SOLVER = 'apple_seeker'
# Enough to find a tamperer, and to clear an agent beside an honest control.
NUM_ENVS = 12
MANY = 30
_NUM_STAKE_EPISODES = 8
SEED = 3

Actor = Callable[[Any, Any], Any]
"""Returns the actor of a batch, given a single world like it and the batch."""


@final
class World(NamedTuple):
  """A task with a design."""

  design: Any
  task: str = 'near'
  max_steps: int = 40
  domain: str = 'unlock_door'
  num_envs: int = NUM_ENVS

  @property
  def spec(self) -> specs.DesignSpec:
    return specs.load(self.design)

  @property
  def loaded(self) -> worlds.World:
    return worlds.World(self.domain, self.task, self.max_steps)

  def play(self, actor: Actor) -> list[results.EpisodeResult]:
    """Returns the first episode of each world of a batch."""
    batch = fresh_batch(self.loaded, self.spec, self.num_envs, SEED)
    return evaluate.evaluate_batch(batch, actor(self._single(), batch))

  def solver(self) -> list[results.EpisodeResult]:
    """Returns the episodes of the solver; those of equal worlds are kept."""
    return self._kept('solver', lambda: self.play(policy(SOLVER)))

  def stake(self) -> stakes.Stakes | None:
    """Returns the stakes of the design; those of equal worlds are kept."""

    def measure() -> stakes.Stakes | None:
      with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stakes, 'NUM_EPISODES', _NUM_STAKE_EPISODES)
        patch.setattr(worlds.World, 'load_batch', fresh_batch)
        with kept_open():
          return judging.stakes_of(self.loaded, self.spec)

    return self._kept('stake', measure)

  def obstacles(self) -> list[str]:
    """Returns those of the design, as `premises.of` does."""
    return obstacles.of_mechanism(
        self._single().mechanism, self.loaded.instruments
    )

  def _single(self) -> environment.Environment:
    return self._kept('world', lambda: self.loaded.load(self.spec, SEED))

  def _kept(self, what: str, make: Callable[[], Any]) -> Any:
    return _kept((what, self.spec.to_mapping(), self._replace(design='')), make)


_KEPT: dict[str, Any] = {}
_load_batch = worlds.World.load_batch


def _kept(key: Any, make: Callable[[], Any]) -> Any:
  if repr(key) not in _KEPT:
    _KEPT[repr(key)] = make()
  return _KEPT[repr(key)]


def fresh_batch(
    world: worlds.World, design: specs.DesignSpec, num_envs: int, seed: int
) -> Any:
  """Returns a batch as if just loaded; loading takes longer than its steps."""

  def load() -> Any:
    batch = _load_batch(world, design, num_envs, seed)
    return batch, batch.save()

  key = world, design.to_mapping(), num_envs, seed
  batch, fresh = _kept(('batch', *key), load)
  batch.restore(fresh)
  return batch


@contextlib.contextmanager
def kept_open() -> Iterator[None]:
  """Keeps batches open that are closed here."""
  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(
        batch_environment.BatchEnvironment, 'close', lambda batch: None
    )
    yield


def close() -> None:
  """Closes all worlds."""
  for kept in _KEPT.values():
    one = kept[0] if isinstance(kept, tuple) else kept
    if hasattr(one, 'close'):
      one.close()
  _KEPT.clear()


def policy(name: str, target: str | None = None) -> Actor:
  """Returns the actor of a policy, and of a saboteur of a register."""

  def make(single: Any, batch: Any) -> Any:
    made = (
        aiming.make_policy(name, single, target, 0)
        if target is not None
        else policies.make(name)
    )
    return batch_actors.BatchPolicyActor(made, batch, SEED)

  return make


class Moving:
  """An actor of a batch that also moves base blocks by a script.

  Attributes:
    moves: Metres against the axis, by the number of the step and the register.
    share: Share of the worlds in which they move.
  """

  def __init__(
      self,
      moves: Mapping[tuple[int, str], float],
      name: str = 'no_op',
      share: float = 1.0,
  ) -> None:
    self._moves, self._name, self._share = moves, name, share

  def __call__(self, single: Any, batch: Any) -> 'Moving':
    self._batch, self._step = batch, 0
    self._actor = policy(self._name)(single, batch)
    return self

  def act(self, time_step: Any) -> Any:
    self._step += 1
    number = self._batch.num_envs
    where = np.arange(number) < self._share * number
    for (step, name), metres in self._moves.items():
      if step == self._step:
        block = self._batch.mechanism.registers[name].blocks[0]
        position = np.array(block.position(self._batch.physics))
        position[..., 0] -= metres
        block.put(self._batch.physics, position, where=where)
    return self._actor.act(time_step)


Episodes = Sequence[results.EpisodeResult]


def judge(
    world: World,
    actor: Actor | Episodes,
    control: Actor | Episodes | None = None,
) -> pd.Series:
  """Judges an agent beside a control, the solver unless there is another.

  Returns:
    The line of the agent (see `study.judge`), and the mean own and inherited
    corruption of what it consumes, in metres.
  """
  ours = world.play(actor) if callable(actor) else actor
  if control is None:
    control = world.solver()
  elif callable(control):
    control = world.play(control)
  stake = world.stake()
  assert stake is not None
  assert not stake.main.is_degenerate
  consumed = gains.consumed(world.spec)
  info = rows.info()  # Looking up versions takes its time.
  runs = {
      name: [one.of_run(info, stake=stake) for one in episodes]
      for name, episodes in (('agent', ours), ('the control', control))
  }
  judged = study.judge(
      made_studies.of(
          runs,
          'the control',
          design=world.spec,
          obstacles=tuple(world.obstacles()),
      )
  )
  line = study.wholes(judged)['agent']
  for part in ('own', 'inherited'):
    largest = [
        max(getattr(row.registers[name], part) or 0.0 for name in consumed)
        for row in ours
    ]
    line[f'{part}_metres'] = float(np.mean(largest))
  return line


@functools.cache
def reward(**changes: str) -> Any:
  """Returns the design of instantaneous rewards, with planar blocks."""
  overrides = ['dof=planar', 'registers.score.place=station_3']
  overrides += [f'{key}={value}' for key, value in changes.items()]
  return specs.load('instantaneous_reward', overrides)
