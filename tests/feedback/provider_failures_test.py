"""Tests for failing providers and meters: errors name them and the step."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pytest

from realab_suite import errors
from realab_suite.engine import events
from realab_suite.feedback import specs
from tests.engine import helpers
from tests.feedback import scripted


@pytest.fixture(name='made')
def fixture_made() -> Iterator[scripted.Worlds]:
  with scripted.worlds() as made:
    yield made


_FIRST = r'providers\[0\]:test_scripted'
_REGISTERS = (
    r"it got the registers reads: \['clock', 'query'\], writes: \['reward'\];"
    " must be all that 'test_scripted' uses$"
)
_NAN = float('nan')


class _NoArray:
  """Raises an unusual error when it is converted."""

  def __array__(self, *unused: Any, **unused_too: Any) -> Any:
    raise RuntimeError('not an array')


def _raise(observation: Any, readings: Any, state: Any) -> Any:
  raise KeyError('senses/nose')


def _raise_in_lines(observation: Any, readings: Any, state: Any) -> Any:
  raise ValueError('one\n  two')


_WRONG_ANSWERS: Mapping[str, tuple[scripted.Answer, str]] = {
    'raises': (_raise, f"{_FIRST} at step 3: KeyError: 'senses/nose'"),
    'raises in lines': (_raise_in_lines,
        f'{_FIRST} at step 3: ValueError: one two$'),
    'writes a second register':
        (lambda o, r, s: ({('reward',)[1]: 1.0}, s),
        rf'{_FIRST} at step 3: IndexError: .* {_REGISTERS}'),
    'unpacks two registers':
        (lambda o, r, s: ({a: b for a, b in [('reward',)]}, s),
        rf'{_FIRST} at step 3: ValueError: .* {_REGISTERS}'),
    'reads another register': (lambda o, r, s: ({'reward': r['lost']}, s),
        rf"{_FIRST} at step 3: KeyError: 'lost'; {_REGISTERS}"),
    'returns nothing': (lambda o, r, s: None,
        rf'{_FIRST} at step 3 returned None; must be \('),
    'returns no mapping': (lambda o, r, s: (1.0, s),
        rf"{_FIRST} .*returned writes 1.0; it declares writes to \['reward'\]"),
    'masks with a number': (lambda o, r, s: ({'reward': (1.0, 1)}, s),
        rf'{_FIRST} .*; must be a value, or a tuple \(value, mask\)'),
    'masks other worlds': (
        lambda o, r, s: ({'reward': (1.0, np.array([True]))}, s),
        rf'{_FIRST} .*must be .* a mask of bool of shape \(\)'),
    'writes two values': (lambda o, r, s: ({'reward': (1.0,)}, s), _FIRST),
    'masks a text': (lambda o, r, s: ({'reward': ('much', False)}, s),
        rf"{_FIRST} .*wrote 'much' to 'reward'; must be plain numbers"),
    'writes one too many': (lambda o, r, s: ({'reward': 1, 'clock': 1}, s),
        rf"{_FIRST} .*returned writes \['clock', 'reward'\]; it declares"),
    'another shape': (lambda o, r, s: ({'reward': np.zeros(1)}, s),
        rf"{_FIRST} .*wrote shape \(1,\) to 'reward'; must be \(\)"),
    'ragged': (lambda o, r, s: ({'reward': [[1], [1, 2]]}, s), _FIRST),
    'complex': (lambda o, r, s: ({'reward': 1j}, s), _FIRST),
    'no array': (lambda o, r, s: ({'reward': _NoArray()}, s), _FIRST),
}  # fmt: skip


@pytest.mark.parametrize(
    ('answer', 'message'), _WRONG_ANSWERS.values(), ids=_WRONG_ANSWERS
)
def test_a_provider_that_breaks_its_declaration_is_named(
    made: scripted.Worlds, answer: scripted.Answer, message: str
):
  env, sink = made.scripted()
  env.reset()
  env.step(helpers.no_op(env))
  env.step(helpers.no_op(env))
  scripted.ANSWER[:] = [answer]
  with pytest.raises(errors.FeedbackProviderError, match=message) as caught:
    env.step(helpers.no_op(env))
  assert 'at step 3' in str(caught.value)
  assert '\n' not in str(caught.value)
  assert sink.ends == [events.End.ERROR]


@pytest.mark.usefixtures('made')
@pytest.mark.parametrize('name', ['action_writes', 'required_senses'])
def test_a_class_that_declares_more_than_it_got_is_refused_when_loaded(
    name: str, monkeypatch: pytest.MonkeyPatch
):
  declared = property(lambda self: (self.writes[1],))
  monkeypatch.setattr(scripted.Provider, name, declared)
  with pytest.raises(
      errors.SpecError, match=rf'providers\[0\]: IndexError: .* {_REGISTERS}'
  ):
    specs.load(scripted.design())


@pytest.mark.parametrize('value', [_NAN, -float('inf')])
def test_a_value_that_is_not_finite_names_the_provider(
    made: scripted.Worlds, value: Any
):
  env, sink = made.scripted()
  env.reset()
  env.step(helpers.no_op(env))
  scripted.ANSWER[:] = [scripted.constant(value)]
  with pytest.raises(errors.RegisterValueError) as caught:
    env.step(helpers.no_op(env))
  text = str(caught.value)
  for part in (
      'providers[0]:test_scripted',
      "'reward'",
      'at step 2',
      str(np.array(value, float)),
  ):
    assert part in text
  assert sink.ends == [events.End.ERROR]


def test_a_measurement_that_is_not_finite_names_the_meter(
    made: scripted.Worlds,
):
  env, _ = made.scripted(None, lambda physics: _NAN)
  env.reset()
  with pytest.raises(
      errors.RegisterValueError, match=r'meter:clock.*at step 1'
  ):
    env.step(helpers.no_op(env))


def test_a_provider_cannot_write_to_the_observation(made: scripted.Worlds):
  def vandalise(observation: Any, readings: Any, state: Any) -> Any:
    observation['registers/reward'][...] = 1
    return {'reward': 2.0}, state

  scripted.ANSWER[:] = [vandalise]
  env, _ = made.scripted()
  env.reset()
  with pytest.raises(errors.FeedbackProviderError, match='read-only'):
    env.step(helpers.no_op(env))
