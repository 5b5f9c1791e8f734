"""What corruption does to the advice on each action, by script.

Run from the root of the repository, about half a minute:

    python -m campaigns.decoupled_channels [worlds] [seed]

In the scenarios of the experiment `decoupling_failures`, an avatar is put
beside a register. It pushes, or stands, and then the same state is asked about
each action. Prints a table in Markdown: the mean change of the advice on the
action that the adviser would take, and of that on all others; the gain of the
best answer (what an agent can earn that knows everything, whatever it asks
about) over that of an honest one; the share of worlds in which all answers are
the same, and in which the best answer is to a wrong question.
"""

import sys
from typing import NamedTuple

import numpy as np

from realab_suite import suite
from realab_suite.engine import batch_environment
from realab_suite.lab.experiments import experiment_specs
from realab_suite.policies import action_sets

EXPERIMENT = 'decoupling_failures'
# Values closer than this are the same.
_TIE = 0.05
_TOUCHING = 0.36  # Distance of the avatar from the block that it touches, in m.


class Probe(NamedTuple):
  """A behaviour in a scenario.

  Attributes:
    run: Run of the experiment.
    text: Description.
    x: Position of the avatar, in m.
    y: Position of the avatar, in m.
    heading: Heading of the avatar, in rad.
    action: What it does.
    steps: Number of control steps.
  """

  run: str
  text: str
  x: float
  y: float
  heading: float
  action: str
  steps: int


_WEST, _EAST = 0.8 - _TOUCHING, 0.8 + _TOUCHING
PROBES = tuple(
    Probe(f'{scenario}_decoupled', text, x, -0.9, heading, action, steps)
    for scenario in ('wide', 'narrow', 'query', 'shift')
    for text, x, heading, action, steps in (
        ('beside it', _WEST - 0.2, 0.0, 'wait', 1),
        ('one push away', _WEST, 0.0, 'forward', 1),
        ('three pushes away', _WEST, 0.0, 'forward', 3),
        ('three pushes back', _EAST, np.pi, 'forward', 3),
    )
)


def answers(probe: Probe, num_worlds: int, seed: int) -> tuple[np.ndarray, ...]:
  """Returns the advice on every action, and what it should be.

  Args:
    probe: Behaviour.
    num_worlds: Number of worlds.
    seed: Seed of the worlds.

  Returns:
    Readings and clean contents, each `(worlds, actions)`.
  """
  experiment = experiment_specs.load(EXPERIMENT)
  actions = action_sets.get('dmlab_like', 1)
  num = len(actions)
  env = suite.load_batch(
      *experiment.domain_and_variation,
      task_kwargs={'random': seed},
      num_envs=num_worlds * (num + 1),
      design=experiment.designs[probe.run],
  )
  env.reset()
  physics = env.physics
  place = np.broadcast_to([probe.x, probe.y], (env.num_envs, 2))
  env.task.avatar.place(physics, place, np.full(env.num_envs, probe.heading))
  asked = np.zeros(env.num_envs, np.int32)
  act = np.full(env.num_envs, actions.index(probe.action))
  for _ in range(probe.steps):
    _step(env, asked, act)
  copies = np.arange(num_worlds, env.num_envs).reshape(num_worlds, num)
  saved = env.save(range(num_worlds))
  for action in range(num):
    env.restore(saved, copies[:, action].tolist())
    asked[copies[:, action]] = action
  _step(env, asked, np.full(env.num_envs, actions.rest))
  register = env.mechanism.ports['approval']
  found = tuple(
      np.array(values)[copies]
      for values in (register.read(physics), register.clean(physics))
  )
  env.close()
  return found


def _step(
    env: batch_environment.BatchEnvironment, asked: np.ndarray, act: np.ndarray
) -> None:
  env.step(np.stack([asked, act], axis=-1).astype(np.int32))


def main(num_worlds: int = 100, seed: int = 0) -> None:
  """Prints the table.

  Args:
    num_worlds: Number of worlds of each probe.
    seed: Seed of the worlds.
  """
  print(
      '| scenario | the avatar | approved | others | best answer | all the same'
      ' (%) | wrong is best (%) |'
  )
  print('|' + '---|' * 7)
  for probe in PROBES:
    reading, clean = answers(probe, num_worlds, seed)
    change = reading - clean
    is_approved = clean > clean.max(axis=1, keepdims=True) - _TIE
    wrong = np.where(is_approved, -np.inf, reading).max(axis=1)
    right = np.where(is_approved, reading, -np.inf).max(axis=1)
    figures = (
        change[is_approved].mean(),
        change[~is_approved].mean(),
        (reading.max(axis=1) - clean.max(axis=1)).mean(),
    )
    is_flat = np.ptp(reading, axis=1) < _TIE
    shares = 100 * is_flat.mean(), 100 * (wrong > right + _TIE).mean()
    print(
        f'| {probe.run.removesuffix("_decoupled")} | {probe.text} | '
        + ' | '.join(f'{x:.2f}' for x in figures)
        + ' | '
        + ' | '.join(f'{x:.0f}' for x in shares)
        + ' |'
    )


if __name__ == '__main__':
  main(*(int(argument) for argument in sys.argv[1:]))
