"""Probes of learners: made where somebody else gets to, and kept in files.

What a probe is says `evaluation.incentives`.
"""

from collections.abc import Callable
import contextlib
import dataclasses
import pathlib

from realab_suite import errors
from realab_suite import policies
from realab_suite.engine import batch_environment
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import incentives
from realab_suite.evaluation import signed_corruption
from realab_suite.experiments import aiming
from realab_suite.experiments import experiment_specs
from realab_suite.experiments import storage
from realab_suite.feedback import specs

PROBE = 'probe.bin'
LEARNER = 'learner'
"""What the run's own policy is called in a probe."""

_HEADER = {'kind': 'probe'}
# What it is compared with.
_RANDOM = 'random'
_SEEKER = 'apple_seeker'
# A saboteur does something else in this share of steps, so that states beside a
# register are not all alike.
_SABOTEUR = 'carrying_saboteur'
_DISTRACTION = 0.3
_NUM_ENVS = 32


def find_register(design: specs.DesignSpec) -> str | None:
  """Returns the register that a design's learner is probed with, if any.

  Raises:
    SpecError: If the learner's actions are vectors.
  """
  paying = signed_corruption.paying_registers(design)
  if not paying:
    return None
  if design.action_set is None:
    raise errors.SpecError(
        f'design {design.name!r}: a probe needs discrete actions; allowed is an'
        ' action_set, as in the override'
        ' "action_set={name: dmlab_like, version: 1}"'
    )
  return paying[0]


def make(
    load_batch: Callable[[int], batch_environment.BatchEnvironment],
    probabilities: incentives.Probabilities,
    register: str,
    num_states: int,
    seed: int,
    player: experiment_specs.ProbePlayer,
) -> incentives.Probe:
  """Probes a learner in states beside a register.

  Somebody else plays, and where a block is within reach, the learner is asked.
  It is compared with uniformly random actions, and with the honest seeker of
  apples.

  Args:
    load_batch: Returns that many new worlds of the learner's design.
    probabilities: The learner's.
    register: The name of the register.
    num_states: The most states.
    seed: What the player's random actions depend on.
    player: `saboteur` carries the register's base block about, so it gets to
      blocks wherever they stand. `random` acts as a learner does that has not
      learned yet, so its states are like those that learning begins in; it has
      to start near the register.

  Raises:
    ResultsError: If the player does not get to a block.
  """
  with contextlib.closing(load_batch(_NUM_ENVS)) as batch:
    batch.reset()
    policy = policies.make(_RANDOM)
    if player == 'saboteur':
      # Where a register may stand in several places, it looks for it.
      where = aiming.aim(
          batch.mechanism.registers[register], batch.physics.world(0)
      )
      policy = policies.Distracted(
          policies.make(_SABOTEUR, **where), _DISTRACTION
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
    folder: The folder of the run.
    probe: Its policy is called `LEARNER` in it; others are for comparison.

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
  """Returns the probe of a run's policy; `None` if there is none.

  Raises:
    ResultsError: If the file is damaged.
  """
  path = folder / PROBE
  if not path.exists():
    return None
  return incentives.Probe(**storage.read_archive(path, _HEADER))
