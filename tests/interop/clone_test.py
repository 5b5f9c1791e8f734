"""Tests that a served world cannot be cloned without its secret salt."""

import contextlib
import dataclasses
import json
import os
import pathlib
import sys
import tempfile
from typing import Any, NamedTuple

from absl import flags
from absl.testing import flagsaver
import pytest

from realab_suite import errors
from realab_suite import worlds
from realab_suite.engine import seeding
from realab_suite.evaluation import results
from realab_suite.experiments import served_evaluation
from realab_suite.experiments import storage
from realab_suite.feedback import specs
from realab_suite.interop.rpc import served_world
from realab_suite.interop.rpc import sockets
from realab_suite.launchers import serve
from tests import patience
from tests.experiments import small
from tests.interop import clones
from tests.interop import served

_NOBODY = 65534
_SEED = 7
_FLAGS = (
    f'--seed={_SEED}',
    '--set=learner=null',  # Without a learner, no stakes are measured.
    f'--max_steps={clones.MAX_STEPS}',
    f'--episodes={clones.NUM_EPISODES}',
)

_is_linux = pytest.mark.skipif(sys.platform != 'linux', reason='needs Linux')
_is_root = pytest.mark.skipif(os.geteuid() != 0, reason='needs root')


def _rows(output):
  return list(results.read_rows(output / 'episodes.jsonl'))


def _num_right(predictions):
  return [prediction.num_right for prediction in predictions]


def _num_time_steps(episodes):
  return [len(episode.digests) for episode in episodes]


def _check_that_only_the_salt_is_missing(output, episodes):
  """Checks the attack itself: with the salt it predicts everything."""
  predictions = clones.predict(clones.make(clones.seed_in(output)), episodes)
  assert _num_right(predictions) == _num_time_steps(episodes)
  returns = [row.true_return for row in _rows(output)]
  assert [prediction.true_return for prediction in predictions] == returns


class _Run(NamedTuple):
  """A served run, and everything that others can see of it."""

  output: pathlib.Path
  address: str
  arguments: dict[str, str]
  given: bytes
  printed: str
  episodes: list[Any]


@pytest.fixture(scope='module', name='run')
def _run(tmp_path_factory):
  output = tmp_path_factory.mktemp('run') / 'results'
  with served.in_process(output, *_FLAGS) as program:
    process = pathlib.Path('/proc', str(program.process.pid))
    given = b''.join(
        (process / name).read_bytes()
        for name in ('cmdline', 'environ')
        if process.exists()
    )
    arguments = {}
    if sys.platform == 'linux':
      arguments = clones.arguments_of(program.process.pid)
    with served.Client(program.address) as client:
      episodes = clones.play(client.env())
    printed = ''.join(program.process.communicate())
    assert program.process.wait(patience.SECONDS) == 0
  return _Run(output, program.address, arguments, given, printed, episodes)


@_is_linux
def test_a_clone_predicts_no_observation_of_any_episode(run):
  assert run.arguments['seed'] == str(_SEED)
  clone = clones.make(int(run.arguments['seed']))
  assert _num_right(clones.predict(clone, run.episodes)) == [0, 0, 0]
  _check_that_only_the_salt_is_missing(run.output, run.episodes)


@_is_linux
@_is_root
def test_a_program_of_another_user_predicts_nothing():
  with tempfile.TemporaryDirectory() as folder:
    os.chmod(folder, 0o755)  # The results are protected by their own mode.
    output = pathlib.Path(folder, 'results')
    with served.in_process(output, *_FLAGS, '--agent_user=nobody') as program:
      report = clones.attack(program, _NOBODY)
      assert program.process.wait(patience.SECONDS) == 0
    isolation = {row.info.isolation for row in _rows(output)}
    assert isolation == {results.SERVED_TO_ANOTHER_USER}
    assert report.arguments['seed'] == str(_SEED)
    assert report.opened == ['cmdline']
    clone = clones.make(int(report.arguments['seed']))
    predictions = clones.predict(clone, report.episodes)
    assert _num_right(predictions) == [0, 0, 0]
    _check_that_only_the_salt_is_missing(output, report.episodes)


def test_runs_of_one_seed_differ(run):
  settings = dataclasses.replace(_settings(None), seed=_SEED)
  _, _, seed = served_evaluation._chosen(settings)
  assert seed == _SEED
  with contextlib.closing(clones.make(seed)) as other:
    position = other.reset().observation['senses/position']
  assert position.tolist() != run.episodes[0].position
  digests = {row.info.salt_digest for row in _rows(run.output)}
  assert digests == {clones.seed_in(run.output).salt_digest}
  assert seed.salt_digest not in digests


# The salt is the evaluator's alone.


def test_the_salt_is_in_the_record_and_nowhere_else(run):
  output = run.output
  forms = clones.forms_of(clones.seed_in(output).salt)
  places = {path.name: path.read_bytes() for path in output.iterdir()}
  places |= {
      'what it is given': run.given,
      'what it prints': run.printed.encode(),
      'names': ' '.join((run.address, *places)).encode(),
  }
  found = [
      name
      for name, data in places.items()
      if any(form in data for form in forms.values())
  ]
  assert found == ['run.json']
  assert 'episodes.jsonl' in places
  modes = {path.stat().st_mode & 0o777 for path in output.iterdir()}
  assert (output.stat().st_mode & 0o777, modes) == (0o700, {0o600})


def test_a_tier_for_other_users_needs_a_salt(monkeypatch):
  monkeypatch.setattr(sockets, 'users_connected_to', lambda _: {_NOBODY})
  tiers = {}
  for seed in (7, seeding.SaltedSeed(7, bytes(seeding.NUM_SALT_BYTES))):
    found = []
    env = clones.make(seed, max_steps=1)
    world = served_world.ServedWorld(
        env, 'unix:/x', 1, lambda result, tier, found=found: found.append(tier)
    )
    world.connect()
    for request in (served.JOIN, served.STEP, served.STEP):
      world.answer(request)
    world.settle()
    env.close()
    tiers[type(seed).__name__] = found
  assert tiers == {
      'int': [results.SERVED],
      'SaltedSeed': [results.SERVED_TO_ANOTHER_USER],
  }


@_is_root
def test_a_folder_of_another_user_is_refused(tmp_path):
  output = tmp_path / 'theirs'
  output.mkdir()
  os.chown(output, _NOBODY, _NOBODY)
  output.chmod(0o777)
  with pytest.raises(errors.SpecError, match='belongs to user 65534; allowed'):
    served_evaluation._make_private_folder(str(output))
  assert not [*output.iterdir()]


# A run that is repeated.


def _readings(salt):
  """Returns readings of what a random provider writes, in some steps."""
  seed = seeding.SaltedSeed(_SEED, salt)
  design = specs.load('online_imitation', ['providers.0.policy=random'])
  with contextlib.closing(clones.make(seed, design)) as env:
    env.reset()
    return [
        float(env.step(0).observation['registers/demonstration'])
        for _ in range(9)
    ]


def test_the_random_numbers_of_providers_depend_on_the_salt():
  salts = [bytes(seeding.NUM_SALT_BYTES), small.SALT]
  assert _readings(salts[0]) == _readings(salts[0]) != _readings(salts[1])


def test_a_record_repeats_a_run(run, tmp_path):
  again = tmp_path / 'again'
  with served.in_process(
      again,
      f'--repeat={run.output / "run.json"}',
      f'--episodes={clones.NUM_EPISODES}',
      task=(),
  ) as program:
    with served.Client(program.address) as client:
      assert clones.play(client.env()) == run.episodes
    assert program.process.wait(patience.SECONDS) == 0
  rows = [
      [row.model_dump_json() for row in _rows(output)]
      for output in (run.output, again)
  ]
  assert rows[0] == rows[1]
  assert clones.seed_in(again).salt == clones.seed_in(run.output).salt


def _settings(record):
  """Returns the settings that `serve` makes of --repeat."""
  return served_evaluation.Settings(
      world=worlds.World('collect_apples', 'standard'), design='none',
      overrides=(), seed=0, repeat=record and str(record), num_episodes=2,
      name='agent', address=None, idle_seconds=patience.SECONDS,
      provider_seconds=patience.SECONDS, agent_command=None,
      agent_folder=None, agent_user=None, output='results',
  )  # fmt: skip


def test_a_record_decides_the_world_the_design_and_the_seed(tmp_path, caplog):
  record = small.write_served_run(tmp_path)
  settings, design, seed = served_evaluation._chosen(_settings(record))
  assert settings.world == worlds.World('unlock_door', 'near', 12)
  assert settings.seed == 7
  assert settings.overrides == ('registers.reward.scale=0.2',)
  assert design.registers['reward'].scale == 0.2
  assert (seed, seed.salt) == (7, small.SALT)
  assert settings.num_episodes == 2
  assert not caplog.messages


def test_a_record_serves_its_twin(tmp_path):
  record = small.write_served_run(tmp_path)
  given = dataclasses.replace(_settings(record), overrides=('channel=secure',))
  settings, design, seed = served_evaluation._chosen(given)
  assert settings.overrides == ('registers.reward.scale=0.2', 'channel=secure')
  assert (design.channel, design.registers['reward'].scale) == ('secure', 0.2)
  assert seed.salt == small.SALT


def test_versions_that_differ_from_the_record_are_named(tmp_path, caplog):
  record = small.write_served_run(tmp_path)
  content = json.loads(record.read_text())
  del content['checksum']
  content['versions']['mujoco'] = '3.0'
  storage.write_sealed(record, content)
  record.chmod(0o600)
  served_evaluation._chosen(_settings(record))
  [message] = caplog.messages
  assert f'{record}: the episodes may differ' in message
  assert "versions.mujoco is '3.0' there" in message


@pytest.mark.parametrize(
    'flag', ['domain', 'task', 'design', 'seed', 'max_steps']
)
def test_flags_that_a_record_decides_are_refused(flag):
  value = '1' if flag in ('seed', 'max_steps') else 'collect_apples'
  with flagsaver.flagsaver():
    flags.FLAGS(['serve', '--output=x', '--repeat=y', f'--{flag}={value}'])
    with pytest.raises(errors.SpecError, match=f'--{flag} has no effect with'):
      serve.main()
