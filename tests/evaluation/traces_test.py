"""Tests of traces: an episode can be repeated from its trace."""

from realab_suite import policies
from realab_suite import suite
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import traces

_NUM_ENVS = 3
_TASK = ('unlock_door', 'near')


def _trace(policy):
  batch = suite.load_batch(
      *_TASK, {'random': 7}, {'max_steps': 40}, num_envs=_NUM_ENVS,
      design='instantaneous_reward',
  )  # fmt: skip
  actor = batch_actors.BatchPolicyActor(policies.make(policy), batch, 7)
  tracer = traces.Tracer(batch, actor)
  batch.add_sink(tracer)
  results = evaluate.evaluate_batch(batch, tracer)
  batch.close()
  return tracer.trace(), results


def test_the_actions_of_a_trace_repeat_the_episode():
  trace, results = _trace('carrying_saboteur')
  assert len(results) == _NUM_ENVS
  for world, result in enumerate(results):
    env = suite.load(
        *_TASK, {'random': 7}, {'max_steps': 40, 'world': world},
        design='instantaneous_reward',
    )  # fmt: skip
    actions = iter(trace['actions'][:, world])
    [alone] = evaluate.evaluate(
        env, lambda time_step, actions=actions: next(actions), 1
    )
    env.close()
    assert alone == result
    assert result.observed_return > 1
