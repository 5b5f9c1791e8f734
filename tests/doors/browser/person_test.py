"""Tests of a person as feedback provider, simulated or recorded."""

import json

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite.doors.browser import answer_sources
from realab_suite.doors.browser import supervised_designs
from realab_suite.evaluation import evaluate
from tests.engine import helpers

_EXACT = {'latency': 0, 'noise': 0.0, 'fatigue': 0.0}


def _evaluate(policy, design, max_steps=60, **kwargs):
  env = suite.load(
      'unlock_door', 'near', {'random': 1}, {'max_steps': max_steps},
      design=design,
  )  # fmt: skip
  [result] = evaluate.evaluate(env, policies.make(policy), 1, **kwargs)
  return result


@pytest.mark.parametrize('asks', ['approval', 'correction', 'comparison'])
def test_a_simulated_person_answers_every_question(asks):
  result = _evaluate('apple_seeker', supervised_designs.design(asks))
  assert result.is_valid
  assert result.registers['feedback'].coverage == 1.0


def test_good_actions_are_approved_and_bad_ones_are_not():
  design = supervised_designs.design('approval', options=_EXACT)
  assert _evaluate('apple_seeker', design).observed_return > 50
  assert _evaluate('carrying_saboteur', design, 20).observed_return < 15


def test_a_person_stops_an_agent_that_does_nothing_good():
  options = {**_EXACT, 'patience': 5}
  design = supervised_designs.design('approval', options=options)
  result = _evaluate('random', design, 250)
  assert result.end.value == 'signal'


def _simulate(steps, **options):
  source = answer_sources.Simulated(**{**_EXACT, **options})
  env = suite.load('unlock_door', 'near', {'random': 1}, design='value_advice')
  observation = env.reset().observation
  state = source.initial_state(())
  found = []
  for step in range(steps):
    value, speaks, state = source.answer(
        answer_sources.Question(
            'approval', observation, np.asarray(1), np.asarray(0),
            np.asarray(True), False, np.asarray(step + 1),
            np.asarray(step == 0), np.array([7, step], np.uint64),
        ),
        state,
    )  # fmt: skip
    found.append(float(value) if speaks else None)
  return found


def test_latency_delays_answers_and_nothing_else_is_asked_meanwhile():
  found = _simulate(9, latency=2)
  assert [value is not None for value in found] == [False, False, True] * 3


def test_recorded_answers_repeat_an_episode(tmp_path):
  env = suite.load(
      'unlock_door', 'near', {'random': 1}, {'max_steps': 30},
      design=supervised_designs.design('approval', 'live'),
  )  # fmt: skip
  log = []

  def ask(question):
    if question.asks == 'stop' or int(question.step) % 3:
      return None
    one = {'asks': question.asks, 'value': 1.0, 'key': question.key.tolist()}
    log.append(json.dumps(one))
    return 1.0

  people = env.mechanism.design.providers
  for person in people:
    person.source.connect(ask)
  [live] = evaluate.evaluate(env, policies.make('random'), 1)
  file = tmp_path / 'answers.jsonl'
  file.write_text('\n'.join(log))
  options = {'file': str(file)}
  design = supervised_designs.design('approval', 'recorded', options)
  again = _evaluate('random', design, 30)
  assert len(log) == 10
  assert again.observed_return == live.observed_return
  assert again.registers == live.registers


def test_a_file_that_has_no_answers_is_refused(tmp_path):
  file = tmp_path / 'answers.jsonl'
  file.write_text('{"asks": "approval"}\n')
  with pytest.raises(errors.SpecError, match='allowed are files of answers'):
    answer_sources.Recorded(str(file))


def test_a_live_source_without_a_person_is_refused():
  design = supervised_designs.design('approval', 'live')
  with pytest.raises(errors.FeedbackProviderError, match='no person'):
    _evaluate('random', design)


def test_a_batch_gets_the_answers_of_single_worlds():
  design = supervised_designs.design('comparison', options={'noise': 0.3})
  arguments = 'unlock_door', 'near', {'random': 1}
  kwargs = {'max_steps': 30}
  batch = suite.load_batch(*arguments, kwargs, num_envs=2, design=design)
  envs = [
      suite.load(*arguments, {**kwargs, 'world': world}, design=design)
      for world in range(2)
  ]
  together, alone = batch.reset(), [env.reset() for env in envs]
  readings = []
  random = np.random.default_rng(0)
  for actions in helpers.draw(batch.action_spec(), (45, 2), random):
    for world, time_step in enumerate(alone):
      expected = time_step.observation['registers/feedback']
      assert together.observation['registers/feedback'][world] == expected
      readings.append(float(expected))
    together = batch.step(actions)
    alone = [env.step(actions[world]) for world, env in enumerate(envs)]
  assert len(set(readings)) > 1
