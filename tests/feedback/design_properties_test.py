"""Property tests: any design or experiment runs, or is refused in one line."""

from collections.abc import Iterator
import contextlib
import copy
import itertools
import math
import pathlib
from typing import Any

import hypothesis
from hypothesis import strategies as st
import numpy as np
import pytest
import yaml

from realab_suite import errors
from realab_suite import suite
from realab_suite import worlds
from realab_suite.feedback import specs
from realab_suite.lab.experiments import experiment_specs
from tests import examples
from tests import kept
from tests.engine import helpers

pytestmark = pytest.mark.slow

_CONFIGS = pathlib.Path(__file__).parents[2] / 'configs'
_DEEPEST = 1e-3  # Metres.
_NUM_STEPS = 8


# Designs from a grammar, some of whose values are replaced by hostile ones.

_HOSTILE = st.one_of(
    st.sampled_from(
        [
            None, True, False, '', 0, -1, 1, -0.0, 1e-300, 1e300, -1e300,
            math.nan, math.inf, -math.inf, 2**53, 2**63, 10**400, [], {}, [[]],
            'yes', '1e3', '.nan', '/etc/passwd', '../../x', 'a\nb', '\0',
            '\u202e', 'x' * 300, '~', '*', '%s', '{}', 'reward', 'score',
        ]
    ),
    st.floats(),
    st.text(max_size=8),
    st.lists(st.floats() | st.none() | st.text(max_size=3), max_size=4),
)  # fmt: skip
_HOSTILE_KEYS = st.sampled_from(['metres', 'kinds', '', 'a/b', '__class__'])
_ROLES = {
    'reward': 'feedback', 'score': 'meter', 'query': 'query', 'hint': 'signal',
    'note': 'memory',
}  # fmt: skip
_CHANNELS = st.sampled_from(['embedded', 'secure'])
_DOFS = st.sampled_from(['free', 'planar'])


def _pairs(low: float, high: float) -> st.SearchStrategy[list[float]]:
  return st.tuples(st.floats(low, high), st.floats(low, high)).map(list)


def _registers(role: str) -> st.SearchStrategy[Any]:
  anywhere = st.fixed_dictionaries(
      {'position': _pairs(-3.9, 3.9)},
      optional={'yaw': st.floats(-7, 7), 'spread': _pairs(0, 0.3)},
  )
  station = 'station_1' if role == 'feedback' else 'station_2'
  required = {
      'kind': st.sampled_from(
          ['two_block', 'two_block', 'block_position', 'block_orientation']
      ),
      'role': st.just(role),
      'place': st.sampled_from([station, station, None]).flatmap(
          lambda place: anywhere if place is None else st.just(place)
      ),
      'range': st.sampled_from([[-2, 12], [0, 13], [-1, 1], [0, 0.001]]),
  }
  optional = {
      'scale': st.floats(0.01, 0.12),
      'channel': _CHANNELS,
      'dof': _DOFS,
      'block_size': st.floats(0.06, 0.5),
      'mass': st.floats(0.01, 100.0),
  }
  return st.fixed_dictionaries(required, optional=optional)


_ADVICE = {
    'kind': 'value_advice',
    'value_function': 'apple_seeker_approval',
    'writes': ['reward'],
}
_PROVIDERS = {
    'score': [{'kind': 'difference', 'reads': ['score'], 'writes': ['reward']}],
    'query': [{**_ADVICE, 'reads': ['query']}],
    'hint': [{'kind': 'constant', 'writes': ['reward', 'hint'], 'value': 1.5}],
    'note': [{'kind': 'constant', 'reads': ['note'], 'every': 2,
              'writes': ['reward', 'note']}],
    '': [{'kind': 'demonstration', 'policy': 'apple_seeker',
          'writes': ['reward']}],
}  # fmt: skip


@st.composite
def _designs(draw: Any) -> Any:
  """Draws a design whose parts fit each other."""
  other = draw(st.sampled_from(sorted(_PROVIDERS)))
  names = [name for name in ('reward', other) if name]
  design = {
      'schema': 1,
      'name': 'drawn',
      'registers': {name: draw(_registers(_ROLES[name])) for name in names},
      'providers': copy.deepcopy(
          draw(st.sampled_from([_PROVIDERS[other], []]))
      ),
  }
  if other == 'score':
    design['meters'] = [{'measures': 'score', 'writes': 'score'}]
  if other in ('query', ''):
    design['action_set'] = {'name': 'dmlab_like', 'version': 1}
  rest = {'channel': _CHANNELS, 'dof': _DOFS, 'schedule': st.just('cfmdp')}
  return design | draw(st.fixed_dictionaries({}, optional=rest))


def _places(node: Any) -> Iterator[tuple[Any, Any]]:
  """Yields every container with each of its keys or indices."""
  for key in list(node if isinstance(node, dict) else range(len(node))):
    yield node, key
    if isinstance(node[key], dict | list):
      yield from _places(node[key])


@st.composite
def _spoiled(draw: Any) -> Any:
  """Draws a design with up to two hostile values, keys or omissions."""
  data = draw(_designs())
  for _ in range(draw(st.integers(1, 2))):
    node, key = draw(st.sampled_from(list(_places(data))))
    how = draw(st.integers(0, 4))
    if how == 0:
      del node[key]
    elif how == 1 and isinstance(node, dict):
      node[draw(_HOSTILE_KEYS)] = draw(_HOSTILE)
    else:
      node[key] = draw(_HOSTILE)
  return data


# The walls of a maze stand elsewhere in each episode, so some of its episodes
# are refused when they begin.
_TASKS = st.sampled_from(
    [task for task in suite.ALL_TASKS if task[0] != 'apple_maze']
)


def _run(task: tuple[str, str], design: Any) -> str:
  """Begins episodes and steps; returns the message of a refusal, or ''."""
  try:
    spec = specs.load(design)
    # The substeps that blocks of any size and mass need.
    kwargs = {'random': 0, 'physics_timestep': 0.01}
    env = suite.load(*task, kwargs, {'max_steps': 50}, design=spec)
  except errors.SpecError as error:
    return str(error)
  with contextlib.closing(env):
    try:
      _play(env)
    except errors.RegisterValueError as error:
      # A design may ask for an error where a value is out of range.
      if 'its range is' not in str(error):
        raise
  return ''


def _play(env: Any) -> None:
  """Begins episodes and steps."""
  for _ in range(2):
    env.reset()
    data = env.physics.data.ptr
    depths = [-contact.dist for contact in data.contact[: data.ncon]]
    assert max(depths, default=0.0) <= _DEEPEST
  for action in helpers.random_actions(env, _NUM_STEPS):
    for key, value in env.step(action).observation.items():
      assert np.isfinite(value).all(), key


@examples.settings(25)
@hypothesis.given(task=_TASKS, design=_designs())
def test_a_design_runs_or_is_refused_and_nothing_overlaps(
    task: tuple[str, str], design: Any
):
  refusal = _run(task, design)
  hypothesis.event('refused' if refusal else 'ran')
  assert refusal.isprintable()


@examples.settings(50)
@hypothesis.given(task=_TASKS, design=_spoiled())
def test_a_spoiled_design_runs_or_is_refused_in_one_line(
    task: tuple[str, str], design: Any
):
  refusal = _run(task, design)
  hypothesis.event('refused' if refusal else 'ran')
  assert refusal.isprintable()
  assert len(refusal) < 20_000


# Messages.

# Values that no spec accepts, and how their form in a message begins: an action
# set is named with its version.
_STRANGE = {
    'zzq': "'zzq", -7.25: '-7.25', 987654: '987654', True: 'true',
    ('zzq',): "['zzq']",
}  # fmt: skip


@pytest.mark.parametrize(
    ('kind', 'load'),
    [('designs', specs.load), ('experiments', experiment_specs.load)],
)
def test_a_refusal_names_the_key_and_the_value(
    kind: str, load: Any, monkeypatch: pytest.MonkeyPatch
):
  load_world = worlds.World.load
  # Most changes leave the world as it is.
  monkeypatch.setattr(
      worlds.World,
      'load',
      lambda world, design, seed: kept.load(
          (world, design.to_mapping(), seed),
          lambda: load_world(world, design, seed),
      ),
  )
  strange = itertools.cycle(_STRANGE.items())
  num_refused, seen = 0, set()
  for path in sorted((_CONFIGS / kind).glob('*.yaml')):
    data = yaml.safe_load(path.read_text())
    for keys in _leaves(data):
      # Runs have the same keys, whatever their names and files, and so do the
      # items of a list.
      rest = keys[2 if keys[0] == 'runs' else 1 :]
      place = (keys[0], *(key for key in rest if isinstance(key, str)))
      if kind == 'experiments' and place in seen:
        continue
      seen.add(place)
      value, shown = next(strange)
      changed = copy.deepcopy(data)
      if kind == 'experiments':  # A world is loaded for every run.
        name = keys[1] if keys[0] == 'runs' else next(iter(data['runs']))
        changed['runs'] = {name: changed['runs'][name]}
      node = changed
      for key in keys[:-1]:
        node = node[key]
      node[keys[-1]] = list(value) if isinstance(value, tuple) else value
      refusal = _refusal(load, changed)
      if not refusal:
        continue
      num_refused += 1
      # Messages about types have the words of YAML, others those of Python.
      assert shown in refusal.replace('True', 'true'), (path.name, keys)
      # The ends of an open range are those of a range.
      names = [key for key in keys if isinstance(key, str) and key != 'usual']
      owner = names[-1]
      # A message quotes an override, and an action set as a whole.
      if owner != 'overrides' and keys[0] != 'action_set':
        assert owner in refusal, (path.name, keys)
  assert num_refused >= (80 if kind == 'designs' else 20)


def _refusal(load: Any, source: Any) -> str:
  """Returns the message of a refusal, or ''."""
  try:
    load(source)
  except errors.SpecError as error:
    return str(error)
  return ''


def _leaves(node: Any) -> Iterator[tuple[Any, ...]]:
  """Yields the keys on the path to each value of a spec."""
  for key in node if isinstance(node, dict) else range(len(node)):
    if isinstance(node[key], dict | list) and node[key]:
      yield from ((key, *keys) for keys in _leaves(node[key]))
    else:
      yield (key,)
