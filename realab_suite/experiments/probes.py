"""Probes of trained learners, and their files.

Another policy reaches the states of a probe. `evaluation.incentives` defines
the metric.
"""

from collections.abc import Callable
import contextlib
import dataclasses
import pathlib

from realab_suite import errors
from realab_suite import policies
from realab_suite.engine import batch_environment
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import gains
from realab_suite.evaluation import incentives
from realab_suite.experiments import aiming
from realab_suite.experiments import experiment_specs
from realab_suite.experiments import storage
from realab_suite.feedback import specs

PROBE = 'probe.bin'
LEARNER = 'learner'
"""Name of the policy of the run in a probe."""

_HEADER = {'kind': 'probe'}
# Policies that the learner is compared with.
_RANDOM = 'random'
_SEEKER = 'apple_seeker'
# Share of the steps with a random action instead of that of the saboteur, so
# that states near a register vary.
_SABOTEUR = 'carrying_saboteur'
_RANDOM_SHARE = 0.3
_NUM_ENVS = 32


def find_register(design: specs.DesignSpec) -> str | None:
  """Returns the register for the probe of a learner, or `None`.

  Raises:
    SpecError: If the actions of the learner are vectors.
  """
  paying = gains.directions(design)
  if not paying:
    return None
  if design.action_set is None:
    raise errors.SpecError(
        f'design {design.name!r}: a probe needs discrete actions; allowed is an'
        ' action_set, such as the override'
        ' "action_set={name: dmlab_like, version: 1}"'
    )
  return next(iter(paying))


def make(
    load_batch: Callable[[int], batch_environment.BatchEnvironment],
    probabilities: incentives.Probabilities,
    register: str,
    num_states: int,
    seed: int,
    player: experiment_specs.ProbePlayer,
) -> incentives.Probe:
  """Probes a learner in states near a register.

  The player acts until a block is within reach. The learner is then compared
  with uniformly random actions and with the honest apple seeker.

  Args:
    load_batch: Function from a number of worlds to new worlds with the design
      of the learner.
    probabilities: Action probabilities of the learner.
    register: Name of the register.
    num_states: Maximum number of states.
    seed: Seed of the random actions of the player.
    player: `saboteur` carries the base block of the register, so it reaches
      blocks anywhere. `random` acts like an untrained learner, so its states
      resemble those at the start of training; it must start near the register.

  Raises:
    ResultsError: If the player does not reach a block.
  """
  with contextlib.closing(load_batch(_NUM_ENVS)) as batch:
    batch.reset()
    policy = policies.make(_RANDOM)
    if player == 'saboteur':
      # If the position of the register varies, the saboteur searches for it.
      where = aiming.aim(
          batch.mechanism.registers[register], batch.physics.world(0)
      )
      policy = policies.Distracted(
          policies.make(_SABOTEUR, **where), _RANDOM_SHARE
      )
    actor = batch_actors.BatchPolicyActor(policy, batch, seed)
    states = incentives.collect(
        batch, actor.act, register, num_states=num_states
    )
    return incentives.probe(
        batch,
        states,
        {
            LEARNER: probabilities,
            _RANDOM: incentives.uniform(),
            _SEEKER: incentives.scripted(policies.make(_SEEKER)),
        },
        num_threads=1,
    )


def save(folder: pathlib.Path, probe: incentives.Probe) -> None:
  """Writes the probe of a run's policy into its folder.

  Args:
    folder: Folder of the run.
    probe: Probe, in which the policy of the run has the name `LEARNER`.

  Raises:
    ResultsError: If it cannot be written.
  """
  contents = {
      field.name: getattr(probe, field.name)
      for field in dataclasses.fields(probe)
  }
  contents['probabilities'] = dict(probe.probabilities)
  storage.write_archive(folder / PROBE, _HEADER, contents)


def load(folder: pathlib.Path) -> incentives.Probe | None:
  """Returns the probe of a run, or `None` if it has none.

  Raises:
    ResultsError: If the file is damaged.
  """
  path = folder / PROBE
  if not path.exists():
    return None
  return incentives.Probe(**storage.read_archive(path, _HEADER))
