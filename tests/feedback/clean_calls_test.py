"""Clean calls: when providers are called again, and that nobody notices."""

import contextlib
import copy
import dataclasses
from typing import Any, Literal

import numpy as np
import pytest

from realab_suite import trees
from realab_suite.doors.browser import person
from realab_suite.feedback import clean_contents
from realab_suite.feedback import providers
from tests.engine import helpers
from tests.feedback import tampered

_every_host = pytest.mark.parametrize('host', tampered.HOSTS)
_PAIR = {
    'reward': tampered.register('feedback'),
    'note': tampered.register('memory'),
}


class _InPlace(providers.Provider):
  """Counts its calls in the array that it got, which it should not."""

  kind: Literal['test_in_place'] = 'test_in_place'

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    return {'calls': np.zeros(batch_shape)}

  def step(
      self, observation: Any, readings: Any, episode_start: Any, key: Any,
      state: Any,
  ) -> tuple[dict[str, Any], Any]:  # fmt: skip
    state['calls'][...] += 1.0
    readings['clock'] += 100.0
    return dict.fromkeys(self.writes, state['calls'] + 0.0), state


@dataclasses.dataclass
class _Memory:
  """A state that cannot be compared: an array has no truth value."""

  values: np.ndarray


class _Object(providers.Provider):
  """Keeps an object as its state, which is possible in a single world."""

  kind: Literal['test_object'] = 'test_object'

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    return _Memory(np.zeros(2))

  def step(
      self, observation: Any, readings: Any, episode_start: Any, key: Any,
      state: Any,
  ) -> tuple[dict[str, Any], Any]:  # fmt: skip
    following = _Memory(state.values + readings['clock'])
    return dict.fromkeys(self.writes, following.values[0]), following


@pytest.fixture(scope='module', name='world_of')
def fixture_world_of():
  with tampered.worlds() as get, contextlib.ExitStack() as stack:
    for kind in (_InPlace, _Object):
      name = kind.model_fields['kind'].default
      stack.enter_context(helpers.registered(providers.PROVIDERS, name, kind))
    yield get


def _adding(reads, writes='reward', **options):
  return {'kind': 'test_adding', 'reads': list(reads), 'writes': [writes],
          **options}  # fmt: skip


_SUMMING = {'kind': 'test_summing', 'reads': ['clock'], 'writes': ['reward']}


def _close(values):
  return pytest.approx(list(values), rel=0, abs=1e-6, nan_ok=True)


# Which worlds are called again.


@_every_host
def test_an_honest_episode_has_no_clean_call(world_of, host):
  design = tampered.design(_PAIR, _adding(['clock'], 'note'),
                           _adding(['note', 'reward']))  # fmt: skip
  world = world_of(host, design)
  tampered.CALLS.clear()
  world.run([], 6)
  shape = (tampered.NUM_ENVS,) if host == 'batch' else ()
  assert tampered.CALLS == [shape] * 12


@_every_host
@pytest.mark.parametrize('kind', [{'kind': 'test_adding'}, _SUMMING])
def test_a_clean_call_has_the_rows_that_need_it(world_of, host, kind):
  world = world_of(host, tampered.design(_PAIR, {**_SUMMING, **kind}))
  tampered.CALLS.clear()
  world.run([(3, 'clock', 5.0), (5, 'clock', -5.0)], 6)
  # In step 5, the observation still shows a reward that is wrong. The state of
  # a sum differs even after the block has returned.
  steps = (3, 4, 5, 6) if kind == _SUMMING else (3, 4, 5)
  actual, clean = ((3,), (1,)) if host == 'batch' else ((), ())
  expected = []
  for step in range(1, 7):
    expected += [actual, clean] if step in steps else [actual]
  assert tampered.CALLS == expected


# Failures.


@_every_host
def test_a_provider_that_fails_on_clean_contents_alone_fails_unseen(
    world_of, host
):
  """What it writes is unknown in that world, and so is what follows from it."""
  found = {}
  for most in (8.0, 1e9):
    design = tampered.design(
        {
            'query': tampered.register('query'),
            'note': tampered.register('memory'),
            'stop': tampered.register('signal'),
        },
        _adding(['clock', 'query'], 'note', most=most),
        _adding(['note'], 'stop'),
    )
    world = world_of(host, design)
    world.begin()
    found[most] = []
    for step in range(1, 7):
      # Clean, the sum is 0, 1, 12, 13, 4 and 5; only honest worlds have that.
      query = 10.0 if step in (3, 4) else 0.0
      world.step([('query', -8.0)] if step == 3 else [], query)
      contents = [world.contents(name) for name in ('note', 'stop')]
      found[most].append((contents, world.seen()))
  steps = zip(found[8.0], found[1e9], strict=True)
  for step, ((failing, seen), (known, same)) in enumerate(steps, start=1):
    assert seen == same
    for one, other in zip(failing, known, strict=True):
      assert one[0] == other[0]
      assert other[1] == pytest.approx([0, 1, 12, 13, 4, 5][step - 1])
      assert one[1] == other[1] if step < 3 else np.isnan(one[1])


@_every_host
def test_changed_arguments_do_not_reach_the_other_call(world_of, host):
  kind = {'kind': 'test_in_place', 'reads': ['clock'], 'writes': ['reward']}
  world = world_of(host, tampered.design(_PAIR, kind))
  honest, _ = world.run([], 5, 'reward')['reward']
  readings, _ = world.run([(2, 'clock', 3.0)], 5, 'reward')['reward']
  assert readings == honest == _close(range(1, 6))


def test_a_state_that_cannot_be_compared_counts_as_another_one(world_of):
  kind = {'kind': 'test_object', 'reads': ['clock'], 'writes': ['reward']}
  world = world_of('single', tampered.design(_PAIR, kind))
  readings, clean = world.run([(2, 'clock', 3.0)], 4, 'reward')['reward']
  assert readings == _close([0, 4, 9, 15])
  assert clean == _close([0, 1, 3, 6])


@pytest.mark.parametrize('value', [0.0, np.zeros(3)])
def test_states_that_differ_in_the_sign_of_zero_differ(value):
  other = np.copysign(value, -1.0) if np.ndim(value) else -value
  assert trees.are_equal({'a': [value]}, {'a': [copy.copy(value)]})
  assert not trees.are_equal({'a': [value]}, {'a': [other]})
  if np.ndim(value):
    other = np.array([0.0, -0.0, 0.0])
    assert trees.differing((value,), (other,)).tolist() == [False, True, False]


@pytest.mark.parametrize(
    ('scale', 'bounds', 'displacement', 'is_disturbed'),
    [
        (0.1, (0.0, 10.0), 9.9e-6, False),
        (0.1, (0.0, 10.0), 1.01e-5, True),
        # A kind may read otherwise than its scale says: this would be a metre
        # in a million units, but no reading leaves the range.
        (1e-6, (0.0, 1.0), 0.9e-6, False),
        (1e-6, (0.0, 1.0), 1.1e-6, True),
    ],
)
def test_negligible_is_small_in_metres_and_beside_the_range(
    scale, bounds, displacement, is_disturbed
):
  most = clean_contents.tolerance(scale, bounds)
  found = clean_contents.is_disturbed(0.5 + displacement, 0.5, 0.5, most)
  assert found == is_disturbed


# People.


_PERSON = {
    'kind': person.KIND,
    'asks': 'approval',
    'reads': ['query'],
    'writes': ['reward'],
    'waits': True,
}
_ASKED = {**_PAIR, 'query': tampered.register('query')}


def test_what_a_person_wrote_is_clean(world_of, monkeypatch):
  world = world_of('single', tampered.design(_ASKED, _PERSON))
  asked = []

  def answer(question):
    asked.append(int(question.query))
    return float(question.query)

  provider = world.mechanism.design.providers[0]
  provider.source.connect(answer)
  moves = [(2, 'query', 3.0), (3, 'reward', 5.0)]
  found = world.run(moves, 4, 'query', 'reward', query=1.0)
  assert asked == [1, 4, 4, 4]  # Once in each step.
  assert found['query'][1] == _close([1, 1, 1, 1])
  assert found['reward'] == (_close([1, 4, 9, 9]), _close([1, 4, 4, 4]))


# Snapshots, taken while actual and clean states differ.

_SAVED = tampered.design(
    {**_PAIR, 'total': tampered.register('feedback')},
    _adding(['clock'], 'note', noise=1.0),
    {**_SUMMING, 'reads': ['note']},
    {**_SUMMING, 'reads': ['clock'], 'writes': ['total'], 'every': 3},
)


def _tampered(world):
  """Plays four steps, of which two are tampered with."""
  world.begin()
  for step in range(1, 5):
    world.step([('clock', 4.0)] if step == 3 else [])
  reading, clean = world.contents('reward')
  assert reading - clean == pytest.approx(8)


def _continued(world):
  """Returns what registers contain in further steps, and what is seen."""
  found = []
  for moves in ([], [('clock', -4.0)], [], []):
    world.step(moves)
    found.append((*map(world.contents, ('reward', 'total')), world.seen()))
  assert found[-1][1][0] - found[-1][1][1] == pytest.approx(4)
  return repr(found)


def _disturbed_elsewhere(world):
  world.begin()
  world.step([('note', 1.0)])


def _restore(single, batch, to_batch, from_batch):
  source, target = (
      batch if is_batch else single for is_batch in (from_batch, to_batch)
  )
  _tampered(source)
  row = [tampered.TAMPERED]
  data = batch.env.save(row) if from_batch else single.env.save()
  _disturbed_elsewhere(target)
  target.env.restore(data, *[row] * to_batch)
  return target


@pytest.mark.parametrize(
    'continue_in',
    [
        lambda *worlds: _restore(*worlds, False, True),
        lambda *worlds: _restore(*worlds, True, False),
    ],
    ids=['single of batch', 'batch of single'],
)
@pytest.mark.usefixtures('world_of')
def test_a_tampered_world_continues_bit_for_bit(continue_in):
  single, batch = (tampered.World(h, _SAVED) for h in ('single', 'batch'))
  same = tampered.World('single', _SAVED)
  _tampered(same)
  continued = continue_in(single, batch)
  assert _continued(continued) == _continued(same)
  for world in (single, batch, same, continued):
    world.close()
