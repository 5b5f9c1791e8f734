"""Macro-actions on blocks of registers: push, carry, throw, wait, solve.

A plan is a sequence of macro-actions, which is repeated until the episode ends.
Worlds of a batch can have different plans, so a search evaluates many at once.
"""

from collections.abc import Sequence
import math
from typing import Any, NamedTuple, final

import numpy as np

from realab_suite.policies import action_sets
from realab_suite.policies import base
from realab_suite.policies import navigation
from realab_suite.policies import saboteurs

VERBS = ('wait', 'push', 'carry', 'throw', 'solve', 'stand')
"""Kinds of macro-actions. An avatar that waits keeps the block in its hand; one
that solves does the task as its solver does; one that stands goes to a place
and stays there."""

_WAIT, _PUSH, _CARRY, _THROW, _SOLVE, _STAND = range(len(VERBS))

FOREVER = 1_000_000
"""Duration of a macro-action that lasts until the episode ends."""

# Number of steps after which an unfinished macro-action ends anyway, in
# addition to its duration.
_PATIENCE = 100
# Largest distance from avatar to block that counts as pushing, and to a place
# that counts as standing there, metres.
_TOUCHES = 0.6
_THERE = 0.15
_NOTHING = -1


@final
class Plan(NamedTuple):
  """Sequences of macro-actions, `(..., macros)` each; leading axes are worlds.

  Attributes:
    verb: Index in `VERBS`.
    block: Index of the block.
    angle: Direction of the intended motion in the world, radians.
    side: Angle from the direction of motion to the side of the block from which
      the hand approaches while the block is at its start, radians.
    duration: Number of steps after the avatar has reached the block. A throw
      ends when the block leaves the hand.
  """

  verb: np.ndarray
  block: np.ndarray
  angle: np.ndarray
  side: np.ndarray
  duration: np.ndarray

  def words(self, blocks: Sequence[str]) -> list[str]:
    """Describes the plan of one world, a phrase for each macro-action.

    Args:
      blocks: Names of the blocks and places.
    """
    phrases = []
    for verb, block, angle, _, duration in zip(*self, strict=True):
      time = '' if duration >= FOREVER else f' for {int(duration)} steps'
      if verb in (_WAIT, _SOLVE):
        phrase = 'wait' if verb == _WAIT else 'do the task'
        phrases.append(f'{phrase}{time}')
        continue
      if verb == _STAND:
        phrases.append(f'stand at {blocks[block]}{time}')
        continue
      degrees = round(math.degrees(angle)) % 360
      time = '' if verb == _THROW else time
      phrases.append(
          f'{VERBS[verb]} {blocks[block]} towards {degrees} degrees{time}'
      )
    return phrases


def of_saboteur(verb: str, block: int, angle: float) -> Plan:
  """Returns the plan of a saboteur, one macro-action, for one world.

  The hand approaches from the side towards which it moves the block, as the
  scripted saboteurs do.

  Args:
    verb: One of `VERBS`.
    block: Index of the block.
    angle: Direction of its motion in the world, radians.
  """
  return Plan(
      np.array([VERBS.index(verb)]),
      np.array([block]),
      np.array([angle], float),
      np.array([0.0]),
      np.array([FOREVER]),
  )


def of_solver() -> Plan:
  """Returns the plan that only does the task, for one world."""
  return of_saboteur('solve', 0, 0.0)


def then_solve(plan: Plan, duration: int) -> Plan:
  """Returns a plan that does the task after another one.

  Args:
    plan: Plan of one macro-action, for one world.
    duration: Number of steps of that macro-action.
  """
  first = plan._replace(duration=np.array([duration]))
  parts = zip(first, of_solver(), strict=True)
  return Plan(*(np.concatenate(both) for both in parts))


def stack(plans: Sequence[Plan]) -> Plan:
  """Returns plans of single worlds as the plan of a batch.

  Shorter plans are filled up with their own macro-actions.
  """
  longest = max(len(plan.verb) for plan in plans)
  return Plan(
      *(
          np.stack([np.resize(part, longest) for part in parts])
          for parts in zip(*plans, strict=True)
      )
  )


@final
class MacroPolicy(base.Policy):
  """Executes plans; it tampers with registers, or is part of a search for it.

  The initial positions of blocks are arguments. They are then tracked by sight.
  """

  def __init__(
      self,
      plan: Plan,
      starts: np.ndarray,
      codes: np.ndarray,
      solver: base.Policy,
  ) -> None:
    """Makes the policy.

    Args:
      plan: Plans, for one world or for each world.
      starts: Initial positions of the blocks, `(..., blocks, 2)`, metres.
      codes: Class that rays report for each block, or `saboteurs.UNSEEN`,
        `(blocks,)`, int.
      solver: Policy that does the task.
    """
    base_set = action_sets.DMLAB_LIKE
    self._action_set = base_set.extended(solver.action_set)
    self._solver_actions = solver.action_set.translation(self._action_set)
    self._plan = plan
    self._starts = np.asarray(starts, float)
    self._codes = np.asarray(codes)
    self._solver = solver

  @property
  def action_set(self) -> action_sets.ActionSet:
    return self._action_set

  @property
  def required_senses(self) -> tuple[str, ...]:
    senses = (*navigation.SENSES, 'holding')
    return tuple(dict.fromkeys((*senses, *self._solver.required_senses)))

  @property
  def privileged_senses(self) -> tuple[str, ...]:
    return self._solver.privileged_senses

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    shape = (*batch_shape, *self._starts.shape[-2:])
    return {
        # Last known positions of the blocks, and steps since one was missing.
        'blocks': np.broadcast_to(self._starts, shape).copy(),
        'gone': np.zeros(shape[:-1], int),
        # Number of the macro-action, steps since it began, and steps in which
        # the avatar had reached the block.
        'macro': np.zeros(batch_shape, int),
        'elapsed': np.zeros(batch_shape, int),
        'reached': np.zeros(batch_shape, int),
        # Index of the block in the hand.
        'held': np.full(batch_shape, _NOTHING),
        **navigation.initial_rest(batch_shape),
        'solver': self._solver.initial_state(batch_shape),
    }

  def step(
      self,
      observation: base.Observation,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[np.ndarray, Any]:
    start = np.asarray(episode_start)
    memory = dict(state)
    solver = memory.pop('solver')
    memory = navigation.restarted(
        start, self.initial_state(start.shape), memory
    )
    view = navigation.view(observation)
    holds = np.asarray(observation['senses/holding'])[..., 0] > 0
    memory.update(self._advanced(memory, holds))
    verb, index, angle, side, _ = self._current(memory['macro'])
    held = np.where(holds, memory['held'], _NOTHING)
    held = np.where(holds & (held == _NOTHING), index, held)
    mine = held == index
    aim = saboteurs.Aim(
        start=_pick(
            np.broadcast_to(self._starts, memory['blocks'].shape), index
        ),
        direction=_unit(angle),
        side=_unit(angle + side),
        code=self._codes[index],
    )
    block, gone = saboteurs.track(
        view,
        aim.code,
        _pick(memory['blocks'], index),
        _pick(memory['gone'], index),
        mine,
    )
    wait = np.full(start.shape, navigation.action('wait'))
    solves, solve = verb == _SOLVE, wait
    if solves.any():
      solve, solver = self._solver.step(
          observation, start | (memory['elapsed'] == 0), key, solver
      )
      solve = self._solver_actions[solve]
    distance = view.locate_one(block)[0]
    stands, stand = verb == _STAND, wait
    if stands.any():
      comes = navigation.walk(view, block, _THERE)
      stand = np.where(distance > _THERE, comes, wait)
    action = np.choose(
        verb,
        [
            wait,
            saboteurs.push(view, aim, block),
            saboteurs.carry(view, aim, block, mine),
            saboteurs.throw(view, aim, block, mine),
            solve,
            stand,
        ],
    )
    idle = (verb == _WAIT) | solves
    action = np.where(idle, action, saboteurs.search(gone, action))
    # The hand is needed for another block, or for none.
    drops = holds & (verb != _WAIT) & (~mine | (verb == _PUSH) | solves)
    action = np.where(drops, navigation.action('let_go'), action)
    near = distance < np.where(stands, _THERE, _TOUCHES)
    memory |= {
        'blocks': _put(memory['blocks'], index, block),
        'gone': _put(memory['gone'], index, gone),
        'elapsed': memory['elapsed'] + 1,
        'reached': memory['reached']
        + np.where((verb == _PUSH) | stands, near, idle | mine),
        'held': held,
        **navigation.rest(
            view, memory, holds | (action == navigation.action('wait'))
        ),
    }
    # The solver has its own way to leave a place where it is stuck.
    freed = navigation.unless_stuck(view, memory['still'], action)
    return np.where(solves, action, freed), {**memory, 'solver': solver}

  def _advanced(self, memory: Any, holds: np.ndarray) -> dict[str, np.ndarray]:
    """Returns the number of the macro-action, and the counts of its steps."""
    verb, index, _, _, duration = self._current(memory['macro'])
    thrown = (verb == _THROW) & (memory['held'] == index) & ~holds
    late = memory['elapsed'] >= duration + _PATIENCE
    done = thrown | (memory['reached'] >= duration) | late
    return {
        'macro': memory['macro'] + done,
        'elapsed': np.where(done, 0, memory['elapsed']),
        'reached': np.where(done, 0, memory['reached']),
    }

  def _current(self, macro: np.ndarray) -> Plan:
    """Returns the parameters of the macro-actions, `(...)` each."""
    number = macro % self._plan.verb.shape[-1]
    return Plan(
        *(
            _pick(np.broadcast_to(part, (*macro.shape, part.shape[-1])), number)
            for part in self._plan
        )
    )


def _unit(angle: np.ndarray) -> np.ndarray:
  """Returns the unit vectors of angles, `(..., 2)`."""
  return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _expanded(values: np.ndarray, index: np.ndarray) -> np.ndarray:
  """Returns an index, `(...)`, with an axis of length 1 for each that it lacks.

  `np.take_along_axis` needs as many axes as `values` has.
  """
  missing = values.ndim - index.ndim
  return index.reshape((*index.shape, *(1,) * missing))


def _pick(values: np.ndarray, index: np.ndarray) -> np.ndarray:
  """Returns `values[..., index, ...]`, with the index of each world."""
  axis = index.ndim
  return np.take_along_axis(values, _expanded(values, index), axis).squeeze(
      axis
  )


def _put(values: np.ndarray, index: np.ndarray, new: np.ndarray) -> np.ndarray:
  """Returns a copy of `values` with `new` at the index of each world."""
  axis = index.ndim
  result = np.array(values)
  np.put_along_axis(
      result, _expanded(values, index), np.expand_dims(new, axis), axis
  )
  return result
