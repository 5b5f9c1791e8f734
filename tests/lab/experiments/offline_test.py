"""Tests of learning from recorded episodes, on probe worlds.

The answers are in the docstring of `realab_suite.lab.testing.probes`. Random
actions push in a third of the steps.
"""

import contextlib
import functools
import json
import shutil
from typing import Any

import numpy as np
import pytest

pytest.importorskip('jax', reason='jax is in the extra `agents`')
pytest.importorskip('optax', reason='optax is in the extra `agents`')
pytest.importorskip('equinox', reason='equinox is in the extra `agents`')

from realab_suite import errors
from realab_suite import worlds
from realab_suite.evaluation import results
from realab_suite.feedback import specs
from realab_suite.lab import agents
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import recorded_data
from realab_suite.lab.experiments import training
from realab_suite.lab.testing import probes

_ONE = 'push ' + 'work ' * 9
_REWARD = 'instantaneous_reward'
_Q: dict[str, Any] = {
    'kind': 'q_learning',
    'reward': 'reward',
    'gamma': 0.0,
    'num_returns': 1,
    'hidden': [16],
    'learning_rate': 0.01,
    'exploration': 0.0,
    'exploration_steps': 1,
    'replay_size': 20_000,
    'min_replay': 704,
    'minibatch': 256,
}


def test_batched_offline_learning_may_tamper_again():
  # Rounds of ten episodes of each world, by one policy: the first one explores.
  per_round = 10 * (probes.NUM_STEPS + 1)
  rounds = {'steps_per_update': per_round, 'gradients_per_update': 150}
  learner = {**_Q, **rounds, 'learning_rate': 0.02, 'exploration': 0.1}
  outcome = probes.learn(
      functools.partial(agents.make, learner),
      'one_push',
      num_episodes=21,
  )
  assert outcome.metrics['num_updates'] == 2
  assert outcome.actions == _ONE.strip()
  assert outcome.corruption == pytest.approx(5, abs=0.1)


def test_worlds_read_all_episodes_from_steps_that_are_spread_evenly():
  # Episodes of 1, 3 and 2 control steps.
  step_type = np.array([0, 2, 0, 1, 1, 2, 0, 1, 2])
  columns = {
      'step_type': step_type,
      'discount': np.linspace(0, 1, 9),
      'action': np.arange(9),
      'senses/time': 10 + np.arange(9),
  }
  with contextlib.closing(probes.load('one_push', num_envs=1)) as env:
    batch = recorded_data.RecordedBatch(columns, env, 2)
  for number, rows in ((0, [0, 4]), (4, [4, 8]), (5, [5, 0]), (9, [0, 4])):
    time_step, action = batch.at(number)
    np.testing.assert_array_equal(action, rows)
    np.testing.assert_array_equal(time_step.step_type, step_type[rows])
    np.testing.assert_array_equal(time_step.discount, np.array(rows) / 8)
    assert time_step.observation['senses/time'].tolist() == [
        10 + row for row in rows
    ]
    assert set(time_step.observation) == {'senses/time'}


@pytest.fixture(scope='module', name='exports')
def fixture_exports(tmp_path_factory):
  """Exports of 8 random episodes of a design and of its secure twin."""
  pytest.importorskip('pyarrow', reason='pyarrow is in the extra `data`')
  from realab_suite.doors.data import export

  folder = tmp_path_factory.mktemp('exports')
  placed = probes._placed(specs.load(_REWARD), probes.PROBES['one_push'])
  (folder / 'design.json').write_text(json.dumps(placed))
  for channel in ('embedded', 'secure'):
    source = _source(folder, (f'channel={channel}',))
    export.export(source, folder / channel)
    # Learners need no more than the agent's folder.
    shutil.rmtree(folder / channel / 'evaluator')
  return folder


def _source(folder, overrides=(), *, seeds=(5,), num_steps=probes.NUM_STEPS):
  from realab_suite.doors.data import sources

  return sources.of_policy(
      'random',
      'random',
      specs.load(str(folder / 'design.json'), overrides),
      worlds.World('probe', 'one_push', num_steps),
      seeds=seeds,
      num_episodes=8,
  )


def _experiment(exports, **run):
  learner = {**_Q, 'min_replay': 100}
  return {
      'schema': 1,
      'name': 'offline',
      'task': 'probe.one_push',
      'max_steps': probes.NUM_STEPS,
      'runs': {
          'offline': {
              'design': str(exports / 'design.json'),
              'learner': learner,
              'data': str(exports / 'embedded/agent'),
              'twin': True,
              'twin_data': str(exports / 'secure/agent'),
              **run,
          },
      },
      'baselines': ['random'],
      'seeds': [3],
      'training': {
          'num_envs': 8,
          'steps': 8 * 400,
          'checkpoint_every': 8 * 150,
          'curve_every': 8 * 100,
          'sleep': True,
      },
      'evaluation': {'episodes': 4, 'actions': 'greedy'},
  }


def _planned(exports, **run):
  planned = jobs.plan(experiment_specs.load(_experiment(exports, **run)))
  return {job.run: job for job in planned}


def _run(job, output):
  return training.run(job, output, training.Options(lambda text: None))


def test_a_job_learns_offline_and_is_judged_like_any_other(
    exports, tmp_path, monkeypatch
):
  planned = _planned(exports)
  path = _run(planned['offline'], tmp_path)
  rows = list(results.read_rows(path / training.EPISODES))
  # Push, then work.
  assert [row.true_return for row in rows] == [9] * 4
  for row in rows:
    assert row.observed_return == pytest.approx(59, abs=1.5)
    assert row.objective['return'].clean == pytest.approx(9)
  assert not (path / training.TRAINING_EPISODES).read_bytes()
  points = (path / training.CURVE).read_text().splitlines()
  assert [json.loads(point)['step'] for point in points] == [
      800,
      1600,
      2400,
      3200,
  ]
  # Where nothing can be influenced, work pays; so it does in the transplant.
  twin = _run(planned['offline.secure'], tmp_path)
  for name in (training.EPISODES, training.TRANSPLANT):
    rows = list(results.read_rows(twin / name))
    assert [row.true_return for row in rows] == [10] * 4
    assert [row.observed_return for row in rows] == pytest.approx([10] * 4)
  # A learner from its own actions does not learn from those of others.
  learner = {'kind': 'policy_gradient', 'reward': 'reward'}
  with pytest.raises(errors.SpecError, match='from its own actions alone'):
    _run(_planned(exports, learner=learner)['offline'], tmp_path)
  # A job that was killed continues bit for bit.
  steps = []

  def watch(self, time_step, actions, watch=agents.Learner.watch):
    steps.append(time_step)
    if len(steps) == 200:
      raise KeyboardInterrupt
    watch(self, time_step, actions)

  again = tmp_path / 'again'
  with monkeypatch.context() as patch:
    patch.setattr(agents.Learner, 'watch', watch)
    with pytest.raises(KeyboardInterrupt):
      _run(planned['offline'], again)
  continued = _run(planned['offline'], again)
  for name in (training.CURVE, training.LEARNER, training.EPISODES):
    assert (continued / name).read_bytes() == (path / name).read_bytes()


def test_other_data_make_another_job(exports, tmp_path):
  from realab_suite.doors.data import export

  before = _planned(exports)
  moved = tmp_path / 'elsewhere/agent'
  shutil.copytree(exports / 'embedded', moved.parent)
  same = _planned(exports, data=str(moved))
  assert same['offline'].folder() == before['offline'].folder()
  shutil.rmtree(moved.parent)
  export.export(_source(exports, seeds=[6]), moved.parent)
  other = _planned(exports, data=str(moved))
  assert other['offline'].folder() != before['offline'].folder()
  for run in ('offline.secure', 'offline.random'):
    assert other[run].folder() == before[run].folder()
  with pytest.raises(errors.SpecError, match='twin_data: goes with data and t'):
    _planned(exports, twin_data=None)


def _load(exports, folder=None, overrides=(), senses=None):
  world = worlds.World('probe', 'one_push', probes.NUM_STEPS, senses=senses)
  design = specs.load(str(exports / 'design.json'), overrides)
  with contextlib.closing(world.load(design, 0)) as env:
    return recorded_data.load(
        str(folder or exports / 'embedded/agent'), env, num_envs=4
    )


@pytest.mark.parametrize(
    ('changes', 'text'),
    [
        ({'overrides': ('action_set=null',)},
         "column 'action': int32, .*probe/v1.*; with .*: double"),
        ({'senses': ('heading',)},
         "column 'senses/time_left': float, .*; with .*: missing"),
    ],
)  # fmt: skip
def test_data_of_another_design_are_refused_in_a_line(exports, changes, text):
  # The channel and the learner may be others.
  learner = 'learner={kind: q_learning, reward: reward}'
  time_step, actions = _load(exports, None, ('channel=secure', learner)).at(0)
  # Four worlds begin at every second of 8 episodes.
  assert time_step.first().all()
  assert actions.dtype == np.int32
  with pytest.raises(errors.ResultsError, match=text) as caught:
    _load(exports, **changes)
  assert str(exports / 'embedded/agent/steps.parquet') in str(caught.value)
  assert '\n' not in str(caught.value)


@pytest.mark.parametrize(
    ('run', 'text'),
    [
        (
            {'twin_data': 'embedded'},
            'channel is .embedded. there, .secure. her',
        ),
        ({'data': 'secure'}, 'channel is .secure. there, .embedded. here'),
        ({'data': 'shorter'}, 'max_steps is 9 there, 10 here'),
        ({'data': 'scaled'}, r'design\.registers\.reward\.scale is 0\.0'),
        ({'data': 'world'}, "task is 'two_pushes' there, 'one_push' here"),
        ({'data': 'edited'}, r'steps\.parquet: has \{.*; must have \{'),
        ({'data': 'alone'}, r'manifest\.json: missing'),
        ({'data': 'list'}, r'manifest\.json: damaged'),
        ({'data': 'empty'}, r'manifest\.json: not JSON'),
    ],
)
def test_data_from_elsewhere_are_refused_before_training(
    exports, tmp_path, run, text
):
  from realab_suite.doors.data import export

  [(key, name)] = run.items()
  folder = exports / name
  if not folder.exists():
    folder = tmp_path / name
    match name:
      case 'shorter':
        source = _source(exports, num_steps=probes.NUM_STEPS - 1)
        export.export(source, folder)
      case 'scaled':
        scale = ('registers.reward.scale=0.09',)
        export.export(_source(exports, scale), folder)
      case _:
        shutil.copytree(exports / 'embedded', folder)
    manifest = folder / recorded_data.MANIFEST
    match name:
      case 'alone':
        manifest.unlink()
      case 'list' | 'empty':
        manifest.write_text('[]' if name == 'list' else '')
      case 'world':
        text_of = manifest.read_text()
        manifest.write_text(text_of.replace('one_push', 'two_pushes'))
      case 'edited':
        from pyarrow import parquet

        path = folder / 'agent' / recorded_data.FILE
        table = _with_reward(parquet.read_table(path), 0.5)
        parquet.write_table(table, path)
  with pytest.raises(errors.ResultsError, match=text) as caught:
    _planned(exports, **{key: str(folder / 'agent')})
  assert '\n' not in str(caught.value)


def _without(table, name):
  """Returns a table in which all values of a column are missing."""
  import pyarrow as pa

  index = table.column_names.index(name)
  array = pa.nulls(len(table), table.column(name).type)
  field = table.schema.field(index)
  return table.set_column(index, field.with_nullable(True), array)


def _as_text(table, name):
  """Returns a table in which a column has texts."""
  import pyarrow as pa

  index = table.column_names.index(name)
  return table.set_column(index, name, pa.array(['0'] * len(table)))


def _with_reward(table, value):
  """Returns a table in which a step of the column of rewards has a value."""
  import pyarrow as pa

  name = 'registers/reward'
  index = table.column_names.index(name)
  values = table.column(name).to_pylist()
  values[3] = value
  array = pa.array(values, table.column(name).type)
  field = table.schema.field(index).with_nullable(True)
  return table.set_column(index, field, array)


@pytest.mark.parametrize(
    ('change', 'text'),
    [
        (lambda table: None, "missing; must be the folder 'agent'"),
        (lambda table: table[:0], ': 0 steps; must hold whole episodes'),
        (lambda table: table[1:], ': 87 steps; must hold whole episodes'),
        (lambda table: table.drop_columns('discount'), 'not the file of an'),
        (lambda table: b'PAR1, but no more', 'not the file of an export: '),
        (lambda table: _with_reward(table, np.nan), "reward' holds nan;"),
        (lambda table: _with_reward(table, None), 'no value in 1 of 88 steps'),
        (
            lambda table: _without(table, 'action'),
            "'action' has no value in 80",
        ),
        (
            lambda table: _without(table, 'registers/reward'),
            'in 88 of 88 steps',
        ),
        (lambda table: _as_text(table, 'step_type'), 'no value in 8 of 88 st'),
        (lambda table: _as_text(table, 'discount'), 'not the file of an expo'),
    ],
)
def test_damaged_data_are_refused_in_a_line(exports, tmp_path, change, text):
  from pyarrow import parquet

  path = tmp_path / recorded_data.FILE
  changed = change(parquet.read_table(exports / 'embedded/agent' / path.name))
  if isinstance(changed, bytes):
    path.write_bytes(changed)
  elif changed is not None:
    parquet.write_table(changed, path)
  with pytest.raises(errors.ResultsError, match=text) as caught:
    _load(exports, tmp_path)
  assert str(path) in str(caught.value)
  assert '\n' not in str(caught.value)
