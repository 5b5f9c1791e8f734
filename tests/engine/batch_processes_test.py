"""Tests for batches and processes: forks, processors and copies."""

import copy
import json
import os
import pickle
import subprocess
import sys

import pytest

from realab_suite import suite
from realab_suite.engine import arguments
from tests import patience

# A child that is refused ends by itself, which frees all that it has.
_FORKS = """
import json
import os
import sys
import warnings
import numpy as np
from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import agent_view

NAMES = 'unlock_door', 'near', {'random': 0}
DESIGN = 'instantaneous_reward'
single = suite.load(*NAMES, design=DESIGN)
single.reset()
batch = suite.load_batch(
    *NAMES, num_envs=4, num_threads=int(sys.argv[1]), design=DESIGN
)
batch.reset()
view = agent_view.BatchAgentView(batch)
physics = batch.physics
snapshot = batch.save()
actions = np.zeros((4, *batch.action_spec().shape))
kept = batch.physics.state[0]
warnings.simplefilter('ignore', DeprecationWarning)
statuses = {}
for use in sys.argv[2:]:
  if os.fork():
    _, status = os.wait()
    batch.step(actions)
    statuses[use] = os.waitstatus_to_exitcode(status)
    continue
  single.step(actions[0])
  suite.load_batch(*NAMES, num_envs=2, num_threads=2, design=DESIGN).reset()
  try:
    exec(use)
  except errors.ForkError as error:
    assert str(os.getppid()) in str(error) and 'num_threads=1' in str(error)
    batch.close()
    sys.exit(7)
  sys.exit()
print(json.dumps(statuses))
"""
_USES = (
    'batch.step(actions)',
    'batch.reset([1])',
    'view.step(actions)',
    'batch.restore(snapshot)',
    'batch.rewind()',
    'batch.physics',
    'physics.forward()',
    'physics.advance(1)',
    'physics.reset(np.array([0]))',
)


def _statuses(num_threads, *uses):
  """Returns the status of a forked child for each use of its batch."""
  ran = subprocess.run(
      [sys.executable, '-c', _FORKS, str(num_threads), *uses],
      stdout=subprocess.PIPE,
      check=True,
      timeout=patience.SECONDS,
  )
  return json.loads(ran.stdout)


def test_threads_of_a_batch_are_refused_in_a_forked_process():
  assert _statuses(2, *_USES) == dict.fromkeys(_USES, 7)


def test_a_batch_without_threads_goes_on_in_a_forked_process():
  assert _statuses(1, _USES[0]) == {_USES[0]: 0}


@pytest.fixture(name='batch', scope='module')
def _batch():
  return suite.load_batch('unlock_door', 'near', num_envs=2, design=None)


@pytest.mark.parametrize('copying', [copy.copy, copy.deepcopy, pickle.dumps])
def test_a_batch_cannot_be_copied(batch, copying):
  with pytest.raises(TypeError, match='environments cannot be pickled'):
    copying(batch)


@pytest.mark.skipif(
    not hasattr(os, 'sched_setaffinity'), reason='no limits of processors'
)
def test_a_batch_has_a_thread_for_each_processor_that_it_may_use():
  allowed = os.sched_getaffinity(0)
  os.sched_setaffinity(0, {min(allowed)})
  try:
    assert arguments.processors() == 1
    batch = suite.load_batch('unlock_door', 'near', num_envs=4, design=None)
    assert batch.physics._batch.nthread == 1
    assert batch.physics._poses.nthread == 1
  finally:
    os.sched_setaffinity(0, allowed)
  assert arguments.processors() == len(allowed)
