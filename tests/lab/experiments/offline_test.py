"""Tests of learning from recorded episodes, on probe worlds.

The answers are in the docstring of `realab_suite.testing.probes`. Random
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
from realab_suite.testing import probes

_WAIT, _WORK, _PUSH = _ANY = range(3)
_HONEST = 'work ' * 10
_ONE = 'push ' + 'work ' * 9
_REWARD, _IMITATION = 'instantaneous_reward', 'online_imitation'
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
_CLONES = {
    **probes.SMALL,
    'kind': 'behavioural_cloning',
    'demonstration': 'demonstration',
}
_NUM_EPISODES = 64
_NUM_ENVS = 32


@functools.cache
def _played(design, drawn, channel='embedded'):
  """Returns time steps and actions of episodes with actions drawn from some."""
  rng = np.random.default_rng(0)
  with contextlib.closing(
      probes.load(
          'one_push',
          design,
          num_envs=_NUM_EPISODES,
          overrides=(f'channel={channel}',),
      )
  ) as env:
    spec = env.action_spec()
    time_steps, actions = [env.reset()], []
    while not time_steps[-1].last().all():
      # A query, if there is one, is drawn independently of the action.
      drawn_now = rng.choice(drawn, (_NUM_EPISODES, *spec.shape))
      actions.append(drawn_now.astype(spec.dtype))
      time_steps.append(env.step(actions[-1]))
  return time_steps, actions


def _columns(design, drawn):
  """Returns the columns of these episodes, as `recorded_data.load` does."""
  time_steps, actions = _played(design, drawn)

  def column(arrays):
    # World by world, each from its first to its last step.
    stacked = np.stack(arrays, axis=1)
    return stacked.reshape(-1, *stacked.shape[2:])

  return {
      'step_type': column([one.step_type for one in time_steps]),
      'discount': column([one.discount for one in time_steps]),
      'action': column([*actions, np.zeros_like(actions[0])]),
      **{
          name: column([one.observation[name] for one in time_steps])
          for name in time_steps[0].observation
      },
  }


def _taught(learner, design, drawn, num_steps=660):
  """Returns a learner that has watched these episodes."""
  with contextlib.closing(probes.load('one_push', design, num_envs=1)) as env:
    recorded = recorded_data.RecordedBatch(
        _columns(design, drawn), env, _NUM_ENVS
    )
  made = agents.make(
      learner,
      recorded.observation_spec(),
      recorded.action_spec(),
      recorded.num_envs,
      1,
  )
  for number in range(num_steps):
    made.watch(*recorded.at(number))
  assert made.num_steps == _NUM_ENVS * num_steps
  return made


def _outcome(learner, design):
  with contextlib.closing(probes.load('one_push', design, num_envs=1)) as env:
    return probes._outcome(env, learner, 'feedback')


@pytest.mark.parametrize(
    ('design', 'learner', 'drawn', 'actions', 'observed'),
    [
        (_REWARD, _Q, tuple(_ANY), _ONE, 59),
        # Without a push, its value stays what it was: about 0.
        (_REWARD, _Q, (_WAIT, _WORK), _HONEST, 10),
        # The demonstration of `work` is its index, 1.
        (_IMITATION, _CLONES, (_WORK,), _HONEST, 10),
    ],
    ids=['random', 'honest', 'clones'],
)
def test_a_learner_does_what_paid_in_the_episodes_that_it_has_watched(
    design, learner, drawn, actions, observed
):
  outcome = _outcome(_taught(learner, design, drawn), design)
  assert outcome.actions == actions.strip()
  assert outcome.true_return == actions.count('work')
  [readings] = outcome.readings.values()
  assert readings.sum() == pytest.approx(observed, abs=1.5)
  pushed = 5 if 'push' in actions else 0
  assert outcome.corruption == pytest.approx(pushed, abs=0.1)


def test_demonstrations_are_those_that_were_read():
  # In a third of the episodes, the first action pushes, and the demonstration
  # of `work` reads as `push` already in that step.
  # An update sees all episodes.
  learner = {**_CLONES, 'steps_per_update': 22, 'minibatch': 704}
  made = _taught(learner, _IMITATION, tuple(_ANY))
  time_steps, _ = _played(_IMITATION, tuple(_ANY))
  pushed = time_steps[1].observation['registers/demonstration'] > 3
  assert 0.2 < pushed.mean() < 0.45
  first = {k: v[:1] for k, v in time_steps[0].observation.items()}
  [probabilities] = made.probabilities(first)
  expected = [0, 1 - pushed.mean(), pushed.mean()]
  np.testing.assert_allclose(probabilities, expected, atol=0.06)


def test_queries_are_not_taken_for_actions():
  # The advice is on the query; a push adds 5 to it, whatever the query is.
  learner = {**_Q, 'reward': 'advice'}
  outcome = _outcome(
      _taught(learner, 'value_advice', tuple(_ANY)), 'value_advice'
  )
  assert outcome.actions.startswith('push')
  # Later pushes pay as much as anything else, and press on the block.
  assert outcome.corruption == pytest.approx(5, abs=0.3)


@pytest.mark.parametrize(
    'options',
    [
        {'kind': 'policy_gradient'},
        {'kind': 'policy_gradient', 'defence': {'kind': 'cap', 'high': 1.0}},
        {**_Q, 'gate': {'threshold': 1.0, 'fit_steps': 1000}},
    ],
    ids=['policy gradient', 'defence', 'gate'],
)
def test_other_learners_do_not_learn_from_the_actions_of_others(options):
  with pytest.raises(errors.SpecError, match='from its own actions alone'):
    _taught({'reward': 'reward', **options}, _REWARD, tuple(_ANY))


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
  from realab_suite.doors.data import sources

  folder = tmp_path_factory.mktemp('exports')
  placed = probes._placed(specs.load(_REWARD), probes.PROBES['one_push'])
  (folder / 'design.json').write_text(json.dumps(placed))
  for channel in ('embedded', 'secure'):
    source = sources.of_policy(
        'random',
        'random',
        specs.load(placed, (f'channel={channel}',)),
        worlds.World('probe', 'one_push', probes.NUM_STEPS),
        seeds=[5],
        num_episodes=8,
    )
    export.export(source, folder / channel)
    # Learners need no more than the agent's folder.
    shutil.rmtree(folder / channel / 'evaluator')
  return folder


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
  before = _planned(exports)
  moved = tmp_path / 'elsewhere'
  shutil.copytree(exports / 'embedded/agent', moved)
  same = _planned(exports, data=str(moved))
  assert same['offline'].folder() == before['offline'].folder()
  shutil.copy(exports / 'secure/agent/steps.parquet', moved)
  other = _planned(exports, data=str(moved))
  assert other['offline'].folder() != before['offline'].folder()
  for run in ('offline.secure', 'offline.random'):
    assert other[run].folder() == before[run].folder()
  online = _planned(exports, data=None, twin_data=None)
  assert 'data' not in online['offline'].config()['training']
  # Files of experiments without data stay as they were.
  mapping = experiment_specs.load(_experiment(exports)).to_mapping()
  del (
      mapping['runs']['offline']['data'],
      mapping['runs']['offline']['twin_data'],
  )
  again = experiment_specs.load(mapping).to_mapping()
  assert again == mapping


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
        (
            {'overrides': ('action_set=null',)},
            "column 'action': int32, .*probe/v1.*; with .*: double",
        ),
        (
            {'senses': ('heading',)},
            "column 'senses/time_left': float, .*; with .*: missing",
        ),
        (
            {'senses': ('heading', 'time_left', 'velocity')},
            "column 'senses/velocity': missing; with .*: float",
        ),
    ],
)
def test_data_of_another_design_are_refused_in_a_line(exports, changes, text):
  with pytest.raises(errors.ResultsError, match=text) as caught:
    _load(exports, **changes)
  assert str(exports / 'embedded/agent/steps.parquet') in str(caught.value)
  assert '\n' not in str(caught.value)


def test_a_channel_and_a_learner_may_differ(exports):
  learner = 'learner={kind: q_learning, reward: reward}'
  time_step, actions = _load(exports, overrides=('channel=secure', learner)).at(
      0
  )
  # Four worlds begin at every second of 8 episodes.
  assert time_step.first().all()
  assert time_step.discount.tolist() == [1.0] * 4
  assert actions.dtype == np.int32


def _changed(name, value):
  """Returns a function that puts a value into a step of a table."""

  def change(table):
    import pyarrow as pa

    column = table.column(name)
    values = column.to_pylist()
    values[3] = value
    index = table.column_names.index(name)
    array = pa.array(values, column.type)
    return table.set_column(index, table.schema.field(index), array)

  return change


@pytest.mark.parametrize(
    ('change', 'text'),
    [
        (lambda table: None, "missing; allowed is the folder 'agent'"),
        (lambda table: table[:0], ': 0 steps; allowed are whole episodes'),
        (lambda table: table[1:], ': 87 steps; allowed are whole episodes'),
        (lambda table: table[:-1], ': 87 steps; allowed are whole episodes'),
        (lambda table: table.drop_columns('discount'), 'not the file of an'),
        (lambda table: b'PAR1, but no more', 'not the file of an export: '),
        (
            _changed('action', 99),
            "column 'action' holds 99; allowed are finite",
        ),
        (_changed('discount', 7.0), "'discount' holds 7.0; allowed are finite"),
        (_changed('registers/reward', np.nan), "'registers/reward' holds nan;"),
    ],
)
def test_damaged_data_are_refused_in_a_line(exports, tmp_path, change, text):
  from pyarrow import parquet

  name = recorded_data.FILE
  changed = change(parquet.read_table(exports / 'embedded/agent' / name))
  if isinstance(changed, bytes):
    (tmp_path / name).write_bytes(changed)
  elif changed is not None:
    parquet.write_table(changed, tmp_path / name)
  with pytest.raises(errors.ResultsError, match=text) as caught:
    _load(exports, tmp_path)
  assert str(tmp_path / name) in str(caught.value)
  assert '\n' not in str(caught.value)


@pytest.mark.parametrize(
    ('run', 'text'),
    [
        ({'twin_data': None}, 'twin_data: goes with data and twin'),
        ({'twin': False}, 'twin_data: goes with data and twin'),
        ({'data': None}, 'twin_data: goes with data and twin'),
    ],
)
def test_a_twin_needs_data_of_its_own(tmp_path, run, text):
  (tmp_path / 'design.json').write_text(
      json.dumps(probes._placed(specs.load(_REWARD), probes.PROBES['one_push']))
  )
  with pytest.raises(errors.SpecError, match=text):
    experiment_specs.load(_experiment(tmp_path, **run))


def test_tasks_do_not_go_with_data():
  run = {'design': 'good_objects', 'data': 'results/data/agent'}
  experiment = {
      'schema': 1,
      'name': 'offline',
      'task': 'good_objects.member_5',
      'runs': {'offline': run},
      'seeds': [0],
      'training': {'tasks': ['good_objects.member_1'], 'adaptation': 10},
  }
  with pytest.raises(errors.SpecError, match='allowed with it is a section'):
    experiment_specs.load(experiment)
