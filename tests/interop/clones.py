"""Clones of a served world, made from data that another user can read.

The package is public, and every user can read the arguments of a process. A
clone with the random streams of a served world predicts all observations and
the true return, in the episodes to come, too.

    python -m tests.interop.clones ADDRESS PID FOLDER USER_ID

is the agent of this attack, as a program of another user; only root can start
it. It prints what it found as JSON.
"""

import base64
from collections.abc import Iterable
import contextlib
import hashlib
import json
import os
import pathlib
import subprocess
import sys
from typing import Any, NamedTuple

import numpy as np

from realab_suite import suite
from realab_suite.engine import environment
from realab_suite.engine import seeding
from realab_suite.feedback import specs
from tests.engine import helpers
from tests.interop import served

DESIGN = 'instantaneous_reward'
MAX_STEPS = 40
NUM_EPISODES = 3
# An action is held for so long, so that the avatar gets somewhere.
_HELD = 10


class Episode(NamedTuple):
  """One episode on the wire, as the agent has it.

  Attributes:
    position: Position of the avatar in the first observation, metres.
    actions: The action of each control step, as plain numbers.
    digests: A hash of each time step; one more than there are actions.
  """

  position: list[float]
  actions: list[Any]
  digests: list[str]


class Prediction(NamedTuple):
  """Predictions of a clone for one episode.

  Attributes:
    num_right: Number of time steps predicted to the last bit.
    true_return: The true return of the clone.
  """

  num_right: int
  true_return: float


class Report(NamedTuple):
  """Findings of a program of another user.

  Attributes:
    opened: The files of the evaluator that it could open, by name.
    arguments: The flags of the process that serves the world.
    episodes: The episodes that it played.
  """

  opened: list[str]
  arguments: dict[str, str]
  episodes: list[Episode]


def play(env: Any, num_episodes: int = NUM_EPISODES) -> list[Episode]:
  """Plays episodes with random actions, and records them.

  Args:
    env: A client's environment; it has one action.
    num_episodes: Number of episodes.
  """
  [(name, spec)] = env.action_spec().items()
  generator = np.random.default_rng(0)
  episodes = []
  for _ in range(num_episodes):
    time_step = env.reset()
    position = time_step.observation['senses/position'].tolist()
    episode = Episode(position, [], [_digest(time_step)])
    while not time_step.last():
      if len(episode.actions) % _HELD == 0:
        action = _draw(spec, generator)
      time_step = env.step({name: action})
      episode.actions.append(action.tolist())
      episode.digests.append(_digest(time_step))
    episodes.append(episode)
  return episodes


def seed_in(output: pathlib.Path) -> seeding.SaltedSeed:
  """Returns the seed and the salt of a run, which its evaluator can read."""
  record = json.loads((output / 'run.json').read_text())
  seed = record['settings']['seed']
  return seeding.SaltedSeed(seed, bytes.fromhex(record['salt']))


def forms_of(salt: bytes) -> dict[str, bytes]:
  """Returns the forms in which a salt may be written."""
  number = int.from_bytes(salt)
  return {
      'bytes': salt,
      'bytes reversed': salt[::-1],
      'hexadecimal': salt.hex().encode(),
      'HEXADECIMAL': salt.hex().upper().encode(),
      'decimal': str(number).encode(),
      'base 64': base64.b64encode(salt).rstrip(b'='),
  }


def arguments_of(pid: int) -> dict[str, str]:
  """Returns the flags of a process, which every user can read."""
  line = pathlib.Path(f'/proc/{pid}/cmdline').read_bytes().decode()
  flags = [part for part in line.split('\0') if part.startswith('--')]
  return dict(flag.removeprefix('--').partition('=')[::2] for flag in flags)


def make(
    random: int, design: specs.Design = DESIGN, max_steps: int = MAX_STEPS
) -> environment.Environment:
  """Returns a clone of the world that `served.in_process` serves.

  Args:
    random: The seed.
    design: The design.
    max_steps: The length of an episode in control steps.
  """
  return suite.load(
      'unlock_door',
      'near',
      {'random': random},
      {'max_steps': max_steps},
      design=design,
  )


def predict(
    clone: environment.Environment, episodes: Iterable[Episode]
) -> list[Prediction]:
  """Repeats episodes in a clone, which it closes.

  Returns:
    For each episode, how much of it the clone predicts.
  """
  predictions = []
  sink = helpers.RecordingSink()
  with contextlib.closing(clone):
    clone.add_sink(sink)
    for number, episode in enumerate(episodes):
      clone.rewind(number)
      sink.heard.clear()
      found = [_digest(clone.reset())]
      found += [_digest(clone.step(np.array(a))) for a in episode.actions]
      pairs = zip(found, episode.digests, strict=True)
      num_right = sum(here == there for here, there in pairs)
      predictions.append(Prediction(num_right, sink.true_return()))
  return predictions


def attack(program: served.Program, user: int) -> Report:
  """Starts the agent of this attack as another user; only root can do that."""
  ran = subprocess.run(
      [
          sys.executable, '-m', 'tests.interop.clones', program.address,
          str(program.process.pid), str(program.output), str(user),
      ],
      cwd=served.ROOT, capture_output=True, text=True, check=True,
  )  # fmt: skip
  opened, arguments, episodes = json.loads(ran.stdout)
  return Report(opened, arguments, [Episode(*episode) for episode in episodes])


def _main(address: str, pid: str, folder: str, user: str) -> None:
  """Attacks a served world as another user."""
  os.setgroups([])
  os.setgid(int(user))
  os.setuid(int(user))
  arguments = arguments_of(int(pid))
  process = pathlib.Path('/proc', pid)
  secrets = ('environ', 'maps', 'mem', 'auxv', 'stack', 'fd/0')
  with served.Client(address) as client:
    env = client.env()
    # While the process surely runs: files of one that ends can be opened, and
    # are empty.
    opened = _opened(process / name for name in ('cmdline', *secrets))
    episodes = play(env)
  names = ('run.json', 'episodes.jsonl')
  opened += _opened(pathlib.Path(folder, name) for name in names)
  print(json.dumps(Report(opened, arguments, episodes)))


def _opened(files: Iterable[pathlib.Path]) -> list[str]:
  """Returns the names of the files that can be opened."""
  opened = []
  for file in files:
    with contextlib.suppress(OSError), open(file, 'rb'):
      opened.append(file.name)
  return opened


def _draw(spec: Any, generator: np.random.Generator) -> np.ndarray:
  """Returns a random action, forward where that is an element of it."""
  if np.issubdtype(spec.dtype, np.integer):
    drawn = generator.integers(spec.minimum, spec.maximum, endpoint=True)
    return np.array(drawn, spec.dtype)
  action = generator.uniform(spec.minimum, spec.maximum)
  action[0] = 1.0
  return np.array(action, spec.dtype)


def _digest(time_step: Any) -> str:
  return hashlib.sha256(served.to_bytes(time_step)).hexdigest()


if __name__ == '__main__':
  _main(*sys.argv[1:])
