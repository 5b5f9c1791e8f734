"""The film of an arm of dm_control that moves its reward register.

The design, the arm's policy and its episode are those of the notebook
`your_own_design`.
"""

import contextlib
import pathlib
from typing import final

from dm_control.mujoco import engine
import numpy as np
from PIL import Image

from pictures import notebooks
from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.entities import protocols
from realab_suite.evaluation import evaluate
from realab_suite.experiments import tracking
from realab_suite.reports import films

_NOTEBOOK = pathlib.Path('docs', 'notebooks', 'your_own_design.ipynb')
_EPISODE = 3
_SIZE = (640, 480)
# Looks almost straight down on the arm and the blocks.
_POSE = {
    'lookat': (0.0, 0.03, 0.0),
    'distance': 0.86,
    'azimuth': 90.0,
    'elevation': -75.0,
}
_TITLE = 'dm_control reacher, with a reward register'
# Frames show every second control step, of 20 ms.
_EVERY = 2
_QUALITY = 40


def draw(path: pathlib.Path) -> None:
  """Writes the film.

  Args:
    path: File to write, an animated picture whose name ends in `.webp`.
  """
  names = notebooks.run(_NOTEBOOK)
  with contextlib.closing(names['load']()) as env:
    recorder = _Recorder(env)
    evaluate.evaluate(
        env, names['sweeper'], 1, first_episode=_EPISODE, sinks=[recorder]
    )
  first, *others = recorder.frames
  first.save(
      path,
      save_all=True,
      append_images=others,
      duration=round(1000 * _EVERY * recorder.timestep),
      loop=0,
      quality=_QUALITY,
  )


@final
class _Recorder(events.EventSink):
  """Event sink that draws frames of an episode.

  Attributes:
    frames: The frames.
    timestep: Duration of a control step, in s.
  """

  def __init__(self, env: environment.Environment) -> None:
    self.frames: list[Image.Image] = []
    self.timestep = env.control_timestep()
    self._env = env
    width, height = _SIZE
    self._camera = engine.MovableCamera(env.physics, height, width)
    self._camera.set_pose(**_POSE)
    self._registers = {
        name: tracking.RegisterTrack(
            register.role, register.blocks[0].half_size
        )
        for name, register in env.mechanism.registers.items()
    }
    self._track = tracking.Track(
        0, _EPISODE, self.timestep, env.max_steps, [], self._registers
    )

  def episode_started(
      self, start: events.Start, physics: protocols.Physics
  ) -> None:
    self._add(start.records)

  def step_ended(self, step: events.Step, physics: protocols.Physics) -> None:
    self._track.true_rewards.append(float(step.true_reward))
    self._add(step.records)

  def episode_ended(self, end: events.End) -> None:
    """Does nothing: the film is complete."""

  def _add(self, records: events.Records) -> None:
    for name, register in self._registers.items():
      own = [record for record in records if record.register == name]
      register.add(own, np.zeros((0, 2)))
    if self._track.num_steps % _EVERY == 0:
      view = self._camera.render()
      strip = films.draw_strip(_TITLE, self._track, _SIZE[0])
      self.frames.append(Image.fromarray(np.concatenate([view, strip])))
