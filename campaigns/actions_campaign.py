"""Campaign C27: hostile actions are refused, and leave no trace.

Run from the root of the repository, about four minutes:

    python -m campaigns.actions_campaign

Between good actions, worlds get hostile ones, in the middle of episodes and
where the next step is to begin one: single worlds and batches, with discrete
actions and vectors, with and without queries. Everything that the future
depends on is compared before and after each refusal, and a twin that gets only
the good actions has to see the same, byte for byte. Prints
`C27 figure target verdict seed`. Arguments are the scale and the seed.
"""

from collections.abc import Callable
import contextlib
import decimal
import fractions
import hashlib
import sys
from typing import Any, NamedTuple

import numpy as np

from campaigns import figure_lines
from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import events
from tests import worlds
from tests.engine import helpers

NUM_ACTIONS = 100_000
NUM_ENVS = 3
_MAX_STEPS = 10
_HOSTILE_BEFORE_GOOD = 5
_MAX_LENGTH = 400  # Of a message.


class Case(NamedTuple):
  """A kind of environment, by its actions."""

  name: str
  design: str
  overrides: tuple[str, ...]
  num_envs: int | None

  def load(self, seed: int) -> Any:
    """Returns a new environment of this kind, or a batch."""
    arguments = 'collect_apples', 'standard', {'random': seed}
    options = {'max_steps': _MAX_STEPS}
    if self.num_envs is None:
      return suite.load(
          *arguments, options, design=self.design, overrides=self.overrides
      )
    return suite.load_batch(
        *arguments,
        options,
        num_envs=self.num_envs,
        num_threads=1,
        design=self.design,
        overrides=self.overrides,
    )


_ACTIONS = {
    'vectors': ('instantaneous_reward', ()),
    'discrete': ('online_imitation', ()),
    'queries and an index': ('paired_decoupled_approval', ()),
    'queries and a vector': (
        'value_advice',
        ('action_set=null', 'providers=[]', 'learner=null'),
    ),
}
CASES = [
    Case(f'{name}, {words}', *design, num_envs)
    for num_envs, words in ((None, 'one world'), (NUM_ENVS, 'batch'))
    for name, design in _ACTIONS.items()
]


class Raises:
  """Raises what it was told to when it is to become an array."""

  def __init__(self, error: Exception) -> None:
    self._error = error

  def __array__(self, *unused: Any, **kwargs: Any) -> Any:
    raise self._error

  def __repr__(self) -> str:
    return 'two\nlines'


class Liar:
  """Says that it is an array of something else than numbers."""

  def __array__(self, *unused: Any, **kwargs: Any) -> Any:
    return np.array([None, 'x'], object)


def _itself() -> list[Any]:
  own: list[Any] = []
  own.append(own)
  return own


def _deep(depth: int) -> Any:
  nested: Any = 0.0
  for _ in range(depth):
    nested = [nested]
  return nested


def _record(shape: tuple[int, ...]) -> np.ndarray:
  return np.zeros(shape, [('a', float)])


_OBJECTS: list[Callable[[tuple[int, ...]], Any]] = [
    lambda shape: None,
    lambda shape: 'forward',
    lambda shape: b'\x00' * 48,
    lambda shape: object(),
    lambda shape: {'forward': 1.0},
    lambda shape: {1.0, 2.0},
    lambda shape: (0.0 for _ in range(6)),
    lambda shape: Raises(ValueError('two\nlines')),
    lambda shape: Raises(TypeError()),
    lambda shape: Raises(MemoryError('no')),
    lambda shape: Raises(RecursionError('no')),
    lambda shape: Raises(ZeroDivisionError('no')),
    lambda shape: Liar(),
    lambda shape: _itself(),
    lambda shape: _deep(100),
    lambda shape: [[1.0], [1.0, 2.0]],
    lambda shape: np.full(shape, None),
    lambda shape: np.full(shape, '0'),
    lambda shape: np.full(shape, b'0'),
    lambda shape: np.full(shape, decimal.Decimal('0')),
    lambda shape: np.full(shape, fractions.Fraction(0)),
    lambda shape: np.full(shape, 10**400, object),
    lambda shape: np.zeros(shape, complex),
    lambda shape: np.zeros(shape, bool),
    lambda shape: np.zeros(shape, 'datetime64[s]'),
    lambda shape: np.zeros(shape, 'timedelta64[s]'),
    _record,
    lambda shape: np.zeros(shape, 'S0'),
]
"""Makers of what holds no numbers, for a shape of actions."""

_NUMBERS: list[float] = [
    np.nan, -np.nan, np.inf, -np.inf, 1e12, -1e12, 1e308, 99.0, 2.0**63,
    -2.0**63, 1e-320 - 99.0,
]  # fmt: skip


def hostile(good: Any, spec: Any, rng: np.random.Generator) -> tuple[str, Any]:
  """Makes a hostile action out of a good one.

  Args:
    good: The good one, of one world or of all.
    spec: The action spec.
    rng: What it depends on.

  Returns:
    What kind it is, and the action.
  """
  kind = int(rng.integers(6))
  values = np.array(good, float)
  if kind == 0:
    make = _OBJECTS[int(rng.integers(len(_OBJECTS)))]
    return 'no numbers', make(values.shape)
  if kind == 1:
    return 'shape', _of_other_shape(good, rng)
  flat = values.reshape(-1)
  where = int(rng.integers(flat.size))
  size = max(1, int(np.prod(spec.shape)))
  low = np.broadcast_to(spec.minimum, spec.shape).reshape(-1)
  high = np.broadcast_to(spec.maximum, spec.shape).reshape(-1)
  bounds = low[where % size], high[where % size]
  if kind == 2:
    flat[where] = _NUMBERS[int(rng.integers(len(_NUMBERS)))]
    return 'number', values
  if kind == 3:
    side = int(rng.integers(2))
    if spec.dtype.kind == 'i':
      flat[where] = bounds[side] + (-1, 1)[side]
      return 'barely outside', values.astype(np.int64)
    flat[where] = np.nextafter(bounds[side], (-np.inf, np.inf)[side])
    return 'barely outside', values
  if kind == 4:
    # Other types, whose numbers are as bad once they are looked at.
    dtype = (np.float32, np.float16, np.longdouble, np.int64, np.uint64)[
        int(rng.integers(5))
    ]
    with np.errstate(all='ignore'):
      other = np.array(np.clip(values, 0, None), dtype)
      worst = np.inf
      if dtype is np.longdouble:
        worst = np.longdouble('1e4000')
      elif np.issubdtype(dtype, np.integer):
        worst = np.iinfo(dtype).max
      other.reshape(-1)[where] = worst
    return 'other type', other
  flat[:] = np.nan
  return 'number', values


def _of_other_shape(good: np.ndarray, rng: np.random.Generator) -> Any:
  """Returns numbers that would be broadcast, cut or padded to fit."""
  good = np.asarray(good)
  zero = np.zeros((), good.dtype)
  shapes = [
      (), (0,), (1,), (1, 1), (2,), (7,), (1, *good.shape), (*good.shape, 1),
      (2, *good.shape), (*good.shape[:-1], 0), good.shape[1:], good.shape[::-1],
      (100_000,),
  ]  # fmt: skip
  fitting = [shape for shape in shapes if shape != good.shape]
  shape = fitting[int(rng.integers(len(fitting)))]
  made = np.broadcast_to(zero, shape)
  return made.tolist() if rng.random() < 0.3 else made


class Counter(events.EventSink, events.BatchEventSink):
  """Counts what an evaluator hears."""

  state_kind = 'counter'

  def __init__(self) -> None:
    self.count = 0

  def episode_started(self, *unused: Any) -> None:
    self.count += 1

  def step_ended(self, *unused: Any) -> None:
    self.count += 1

  def episode_ended(self, *unused: Any) -> None:
    self.count += 1


def fingerprint(env: Any, counter: Counter) -> bytes:
  """Returns a hash of everything that the future depends on.

  Every attribute counts but what never changes and what has a state elsewhere,
  so that one which is added later counts, too.
  """
  digest = hashlib.sha256()
  physics = env.physics
  if hasattr(env, 'num_envs'):
    digest.update(np.ascontiguousarray(physics.state).tobytes())
  else:
    digest.update(worlds.state_bytes(physics))
    for name in ('ctrl', 'qacc', 'xpos', 'xfrc_applied', 'mocap_pos'):
      digest.update(np.ascontiguousarray(getattr(physics.data, name)).tobytes())
  plain = {
      name: value
      for name, value in vars(env).items()
      if isinstance(
          value, int | float | str | bool | list | tuple | dict | np.ndarray
      )
      and name not in ('_sinks', '_entities')
  }
  digest.update(_canonical(plain))
  digest.update(_canonical(env._random_state.get_state(legacy=False)))
  digest.update(str(counter.count).encode())
  return digest.digest()


def _canonical(value: Any) -> bytes:
  if isinstance(value, dict):
    parts = [
        part
        for key in value
        for part in (str(key).encode(), _canonical(value[key]))
    ]
    return b'{' + b','.join(parts) + b'}'
  if isinstance(value, list | tuple):
    return b'[' + b','.join(map(_canonical, value)) + b']'
  if isinstance(value, np.ndarray):
    content = value.tolist() if value.dtype == object else value.tobytes()
    return repr((value.dtype.str, value.shape, content)).encode()
  return repr(value).encode()


def good_action(env: Any, rng: np.random.Generator) -> np.ndarray:
  """Draws an action that fits, for one world or for all."""
  spec = env.action_spec()
  lead = (env.num_envs,) if hasattr(env, 'num_envs') else ()
  return np.asarray(helpers.draw(spec, lead, rng))


def to_bytes(time_step: Any) -> bytes:
  """Returns all that an agent gets, of one world or of many."""
  return _canonical(
      [
          np.asarray(time_step.step_type),
          time_step.reward,
          time_step.discount,
          dict(time_step.observation),
      ]
  )


class Figures(NamedTuple):
  """What came of hostile actions in one environment."""

  refused: int
  accepted: int
  other_errors: int
  unclear: int
  changed: int
  differing: int
  pending: int
  kinds: frozenset[str]
  first: str


def play(
    case: Case,
    number: int,
    seed: int,
    refuse: Callable[[Any, Any], Any] | None = None,
) -> Figures:
  """Sends hostile actions among good ones.

  Args:
    case: To what.
    number: How many hostile actions.
    seed: What they depend on.
    refuse: Takes the step instead of the environment, for tests of the test.
  """
  step = refuse or (lambda env, action: env.step(action))
  rng = np.random.default_rng(seed)
  counts = dict.fromkeys(
      ('refused', 'accepted', 'other_errors', 'unclear', 'changed', 'differing',
       'pending'), 0,
  )  # fmt: skip
  kinds, first = set(), ''
  with contextlib.ExitStack() as stack:
    env, twin = (
        stack.enter_context(contextlib.closing(case.load(seed)))
        for _ in range(2)
    )
    counter = Counter()
    env.add_sink(counter)
    seen, expected = env.reset(), twin.reset()
    counts['differing'] += to_bytes(seen) != to_bytes(expected)
    tried = 0
    while tried < number:
      good = good_action(env, rng)
      for _ in range(min(_HOSTILE_BEFORE_GOOD, number - tried)):
        tried += 1
        kind, action = hostile(good, env.action_spec(), rng)
        kinds.add(kind)
        # Where the next step is to begin an episode, actions are checked, too.
        counts['pending'] += bool(np.any(np.asarray(expected.step_type) == 2))
        before = fingerprint(env, counter)
        problem = ''
        try:
          step(env, action)
          counts['accepted'] += 1
          problem = 'accepted'
        except errors.ActionError as error:
          counts['refused'] += 1
          text = str(error)
          if not text.isprintable() or not 0 < len(text) <= _MAX_LENGTH:
            counts['unclear'] += 1
            problem = text
        except Exception as error:
          counts['other_errors'] += 1
          problem = f'{type(error).__name__}: {error}'
        if fingerprint(env, counter) != before:
          counts['changed'] += 1
          problem = problem or 'changed'
        if problem and not first:
          first = f'{case.name}, {kind}: {problem!r:.200} for {action!r:.200}'
      seen, expected = env.step(good), twin.step(good)
      counts['differing'] += to_bytes(seen) != to_bytes(expected)
  return Figures(**counts, kinds=frozenset(kinds), first=first)


def main(scale: float = 1.0, seed: int = 0) -> int:
  """Prints figures and returns the number of targets missed."""
  lines = figure_lines.Lines('C27', seed)
  number = max(60, round(scale * NUM_ACTIONS / len(CASES)))
  for i, case in enumerate(CASES):
    found = play(case, number, seed + i)
    lines.at_least(f'{case.name}: refused', found.refused, number)
    bad = found.accepted + found.other_errors
    lines.at_most(f'{case.name}: accepted, or other errors', bad, 0)
    lines.at_most(f'{case.name}: unclear messages', found.unclear, 0)
    lines.at_most(f'{case.name}: state changes', found.changed, 0)
    lines.at_most(f'{case.name}: steps unlike the twin', found.differing, 0)
    lines.at_least(f'{case.name}: before a reset', found.pending, 1)
    if found.first:
      print(found.first, file=sys.stderr)
  return lines.num_missed


if __name__ == '__main__':
  figure_lines.run(main)
