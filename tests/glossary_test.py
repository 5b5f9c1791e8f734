"""Tests of the glossary: its examples of clean contents."""

import pathlib
import re

import pytest

from realab_suite.doors.browser import person
from realab_suite.engine import events
from tests.engine import helpers
from tests.feedback import tampered

_PAGE = pathlib.Path(__file__).parents[1] / 'GLOSSARY.md'
_REWARD = {'reward': tampered.register('feedback')}
_QUERY = {**_REWARD, 'query': tampered.register('query')}
_NOTE = {**_REWARD, 'note': tampered.register('memory')}


def _adding(reads, writes='reward', **options):
  return {
      'kind': 'test_adding', 'reads': reads, 'writes': [writes], **options,
  }  # fmt: skip


def _of_clock(registers=_REWARD):
  return tampered.design(registers, _adding(['clock']))


def _moved(*names, step=3):
  return [(step, name, 10.0) for name in names]


_ASKED_PERSON = {
    'kind': person.KIND, 'asks': 'approval', 'reads': ['query'],
    'writes': ['reward'], 'waits': True,
}  # fmt: skip
_CHAIN = tampered.design(_NOTE, _adding(['clock'], 'note'), _adding(['note']))
_PERSON = tampered.design(_QUERY, _ASKED_PERSON)
_STOP = {'stop': tampered.register('signal', ends_episode={'above': 11})}
# The design of each example and its moves, by the first words of the example.
_EXAMPLES = {
    'A meter register': (_of_clock(), _moved('clock')),
    'The clock': (_of_clock(), _moved('clock')),
    'A feedback register': (_of_clock(), _moved('reward')),
    'Both': (_of_clock(), _moved('clock', 'reward')),
    'The query': (
        tampered.design(_QUERY, _adding(['query'])), _moved('query'),
    ),
    'A memory register': (_CHAIN, _moved('note')),
    'A signal': (
        tampered.design(_STOP, _adding(['clock'], 'stop')), _moved('stop'),
    ),
    'A provider that is silent': (
        tampered.design(_NOTE, _adding(['clock', 'note'], gate='note')),
        _moved('note'),
    ),
    'A range': (
        _of_clock({'reward': tampered.register('feedback', range=[-50, 2])}),
        _moved('clock', step=2),
    ),
    'A provider with a state': (
        tampered.design(
            _REWARD,
            {'kind': 'test_summing', 'reads': ['clock'], 'writes': ['reward']},
        ),
        [*_moved('clock'), (4, 'clock', -10.0)],
    ),
    'A provider with noise': (
        tampered.design(_REWARD, _adding(['clock'], noise=3.0)),
        _moved('clock'),
    ),
    'A person': (_PERSON, _moved('query')),
    'The register of the person': (_PERSON, _moved('reward')),
}  # fmt: skip


# More examples than the page shows, with its columns.
_MORE = """
A memory register | reward | 0, 1, 12, 13, 14 | 0, 1, 2, 3, 4 | 0, 10
A provider that is silent | reward | 0, 1, 1, 1, 1 | 0, 1, 2, 3, 4 | 0, -3
A provider with noise | reward | 0, 1, 12, 13, 14 | 0, 1, 2, 3, 4 | 0, 10
A person | reward | 1, 1, 1, 1, 1 | 1, 1, 1, 1, 1 | 0, 0
The register of the person | reward | 1, 1, 11, 11, 11 | 1, 1, 1, 1, 1 | 10, 0
"""


def _rows():
  """Returns the rows of the examples, without the header of the page."""
  text = _PAGE.read_text().partition('## Clean contents by hand')[2]
  lines = re.findall(r'^\| (.*) \|$', text, re.M) + _MORE.strip().splitlines()
  return [row.split(' | ') for row in lines if not row.startswith('Example')]


def _numbers(cell):
  return [float(number) for number in re.findall(r'-?\d+', cell)]


@pytest.fixture(scope='module', name='world_of')
def fixture_world_of():
  with tampered.worlds() as get:
    yield get


@pytest.mark.parametrize('row', _rows(), ids=lambda row: row[0])
def test_an_example_of_clean_contents_is_correct(world_of, row):
  words, register, readings, clean, corruption = row
  [(design, moves)] = [
      example for start, example in _EXAMPLES.items() if words.startswith(start)
  ]
  world = world_of('single', design)
  for provider in world.mechanism.design.providers:
    if provider.kind == person.KIND:
      provider.source.connect(lambda question: 1.0)
  sink = helpers.RecordingSink()
  world.env.add_sink(sink)
  expected = _numbers(readings), _numbers(clean)
  number = len(expected[0])
  found = world.run(moves, number, register, query=1.0)[register]
  one = world.mechanism.registers[register]
  own = float(one.read(world.physics) - one.applied(world.physics))
  inherited = found[0][-1] - found[1][-1] - own
  if 'noise' in words:
    noise = [a - b for a, b in zip(found[1], expected[1], strict=True)]
    assert max(map(abs, noise)) > 0.1
    expected = tuple(
        [a + b for a, b in zip(side, noise, strict=True)] for side in expected
    )
  for side, values in zip(found, expected, strict=True):
    assert side == pytest.approx(values, rel=0, abs=1e-6)
  assert [own, inherited] == pytest.approx(_numbers(corruption), abs=1e-6)
  is_ended = 'ended by tampering' in words
  assert world.time_step.last() == is_ended
  if is_ended:
    assert sink.ends == [events.End.SIGNAL]


def test_every_example_has_a_row():
  assert len(_rows()) == len(_EXAMPLES)
