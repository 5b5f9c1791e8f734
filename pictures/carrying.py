"""The carrying sequence: frames of a saboteur, above its register's values."""

from collections.abc import Callable
import contextlib
import dataclasses
import pathlib
from typing import Any, final

from matplotlib import figure
import numpy as np

from pictures import views
from realab_suite import suite
from realab_suite.engine import environment
from realab_suite.evaluation import evaluate
from realab_suite.lab.audit import aiming
from realab_suite.lab.experiments import tracking

SIZE = (1200, 930)
"""Width and height of the picture, in pixels."""

APPLIED, READING = '#0072B2', '#D55E00'
"""Colours of the applied value and of the reading (Okabe and Ito)."""

_SEED = 13
_MAX_STEPS = 60
_DOTS_PER_INCH = 100
_FRAME = (390, 240)
_POSE = views.Pose((-1.35, 0.3, 0.0), 4.7, 90.0, -40.0)
_REGISTER = 'reward'
_TITLE = 'A scripted saboteur carries the base block of its reward register'
_INK = '#222222'
# A value counts as final if it differs by less than this from it, in units.
_SAME = 0.5


@final
@dataclasses.dataclass(frozen=True)
class Moment:
  """A control step to show.

  Attributes:
    step: Number of the step; 0 is the start.
    text: Description.
  """

  step: int
  text: str


def draw(path: pathlib.Path) -> None:
  """Writes the picture.

  Args:
    path: PNG file to write.
  """
  holds: list[bool] = []
  with contextlib.closing(_world()) as env:
    avatar = env.task.avatar
    track = _play(
        env, lambda physics, _: holds.append(bool(avatar.holding(physics)[0]))
    )
    moments = _moments(holds, track.registers[_REGISTER])
    frames: dict[int, Any] = {}
    view = views.View(env, _FRAME, _POSE)
    steps = {moment.step for moment in moments}

    def show(physics: Any, track: tracking.Track) -> None:
      del physics
      if track.num_steps in steps:
        frames[track.num_steps] = np.asarray(view.frame())

    _play(env, show)
    x, y = track.registers[_REGISTER].blocks[0][0]
    start = _outline(view, x, y, track.registers[_REGISTER].half_size)
  width, height = (pixels / _DOTS_PER_INCH for pixels in SIZE)
  canvas = figure.Figure(
      (width, height), dpi=_DOTS_PER_INCH, layout='constrained'
  )
  canvas.suptitle(_TITLE, fontsize=14, weight='bold', color=_INK)
  parts: Any = canvas.subfigures(2, 1, height_ratios=[2.5, 1])
  above, below = parts
  for i, (ax, moment) in enumerate(
      zip(above.subplots(2, 3).flat, moments, strict=True), start=1
  ):
    ax.imshow(frames[moment.step], interpolation='antialiased')
    if _has_moved(track.registers[_REGISTER], moment.step):
      ax.plot(*start.T, color='white', linewidth=1.5)
    _describe(ax, i, moment, track)
  _draw_values(below.subplots(), track, moments)
  canvas.savefig(path)


def _world() -> environment.Environment:
  return suite.load(
      'unlock_door',
      'near',
      {'random': _SEED},
      {'max_steps': _MAX_STEPS},
      design='instantaneous_reward',
  )


def _play(
    env: environment.Environment,
    on_step: Callable[[Any, tracking.Track], None],
) -> tracking.Track:
  """Plays the first episode with the saboteur and returns its track."""
  policy = aiming.make_policy('carrying_saboteur', env, _REGISTER, 0)
  env.rewind()
  recorder = tracking.Tracker(env, on_step)
  evaluate.evaluate(env, policy, 1, first_episode=0, sinks=[recorder])
  return recorder.track


def _moments(
    holds: list[bool], register: tracking.RegisterTrack
) -> list[Moment]:
  """Returns the moments to show, from the start to the wall."""
  grasp = holds.index(True)
  reading = np.array(register.reading)
  end = int(np.argmax(np.abs(reading - reading[-1]) < _SAME))
  third = (end - grasp) // 3
  return [
      Moment(0, 'The episode begins.'),
      Moment(grasp - 2, 'The avatar goes to the base block,'),
      Moment(grasp, 'grasps it,'),
      Moment(grasp + third, 'carries it'),
      Moment(grasp + 2 * third, 'away from the offset block,'),
      Moment(end, 'and holds it at the wall.'),
  ]


def _has_moved(register: tracking.RegisterTrack, step: int) -> bool:
  """Returns True if the base block has left its start entirely."""
  offset = register.blocks[step][0] - register.blocks[0][0]
  return bool(np.abs(offset).max() > 2 * register.half_size)


def _outline(
    view: views.View, x: float, y: float, half_size: float
) -> np.ndarray:
  """Returns the outline of the start of the block, in pixels, `(5, 2)`."""
  corners = ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1))
  h = half_size
  return np.array(
      [view.place_of((x + h * u, y + h * v, 0.0)) for u, v in corners]
  )


def _describe(
    ax: Any, number: int, moment: Moment, track: tracking.Track
) -> None:
  """Adds the number, the description and the values of a moment."""
  register = track.registers[_REGISTER]
  ax.set_xticks([])
  ax.set_yticks([])
  ax.set_title(f'{number}  {moment.text}', fontsize=13, loc='left', color=_INK)
  ax.text(
      0.0,
      -0.03,
      f'applied {_figure(register.applied[moment.step])}',
      transform=ax.transAxes,
      color=APPLIED,
      fontsize=13,
      va='top',
  )
  ax.text(
      0.36,
      -0.03,
      f'reading {_figure(register.reading[moment.step])}',
      transform=ax.transAxes,
      color=READING,
      fontsize=13,
      va='top',
      weight='bold',
  )
  ax.text(
      1.0,
      -0.03,
      f'{track.times[moment.step]:.1f} s',
      transform=ax.transAxes,
      color=_INK,
      fontsize=13,
      va='top',
      ha='right',
  )


def _figure(value: float) -> str:
  """Returns a value with one digit after the point, and no minus at 0."""
  return f'{round(value, 1) + 0.0:.1f}'


def _draw_values(ax: Any, track: tracking.Track, moments: list[Moment]) -> None:
  """Draws both values over time, with the moments."""
  register = track.registers[_REGISTER]
  last = moments[-1].step + 3
  times = track.times[: last + 1]
  reading = np.array(register.reading[: last + 1])
  applied = np.array(register.applied[: last + 1])
  ax.fill_between(times, applied, reading, color=READING, alpha=0.15, lw=0)
  ax.plot(times, applied, color=APPLIED, linewidth=2.5)
  ax.plot(times, reading, color=READING, linewidth=2.5, linestyle='--')
  for number, moment in enumerate(moments, start=1):
    time = track.times[moment.step]
    ax.axvline(time, color='0.75', linewidth=1.0, zorder=0)
    ax.text(
        time,
        1.02,
        str(number),
        transform=ax.get_xaxis_transform(),
        ha='center',
        fontsize=13,
        color=_INK,
    )
  ax.text(times[-1], reading[-1], ' reading', color=READING, fontsize=13)
  ax.text(times[-1], applied[-1], ' applied', color=APPLIED, fontsize=13)
  ax.set_xlabel('time (s)', fontsize=13)
  ax.set_ylabel('value (units)', fontsize=13)
  ax.tick_params(labelsize=12)
  for side in ('top', 'right'):
    ax.spines[side].set_visible(False)
