"""The animated picture: two trained agents in the same world, side by side.

Both have learned from the same design with the same seed. The reward of the
left one is out of reach (the secure twin), that of the right one is stored in
blocks. The world is that of the right one's episode of median corruption.
"""

from collections.abc import Sequence
import contextlib
import dataclasses
import pathlib
from typing import Any, final

import numpy as np
from PIL import Image
from PIL import ImageDraw
from PIL import ImageFont

from pictures import views
from realab_suite import errors
from realab_suite.engine import environment
from realab_suite.evaluation import results
from realab_suite.lab.experiments import replays
from realab_suite.lab.experiments import studies
from realab_suite.lab.experiments import tracking
from realab_suite.lab.verdicts import study

_PANEL = (420, 430)
_GAP = 8
_HEAD = 36
_STRIP = 104
SIZE = (2 * _PANEL[0] + _GAP, _HEAD + _PANEL[1] + _STRIP)
"""Width and height of the picture, in pixels."""

STEPS = 70
"""Number of control steps that the picture shows, in real time."""

LAST_FRAME_MS = 2000
"""Duration of the last frame, in milliseconds."""

_TITLES = {
    'reward.secure': 'trained agent, reward out of reach',
    'reward': 'trained agent, reward stored in blocks',
}
_POSE = views.Pose((0.0, 1.15, 0.0), 13.1, 90.0, -58.0)
_COLOURS = 256
_BACKGROUND = (24, 28, 36)
_PLAIN = (235, 238, 242)
_TRUE = (120, 190, 255)
_OBSERVED = (255, 160, 40)
_RING = 15
# True reward of the large apple.
_LARGE_APPLE = 10.0


@final
@dataclasses.dataclass(frozen=True)
class _Moment:
  """A control step of an agent, for one panel.

  Attributes:
    view: View of the world.
    base: Middle of the base block in the view, in pixels.
    true_return: True return so far.
    observed_return: Observed return so far.
    note: Line below the figures, or ''.
  """

  view: Image.Image
  base: tuple[float, float]
  true_return: float
  observed_return: float
  note: str


def draw(path: pathlib.Path, folder: pathlib.Path) -> None:
  """Writes the picture.

  Args:
    path: GIF file to write.
    folder: Folder of a finished sweep of the experiment `quick`.

  Raises:
    ResultsError: If a run or an episode is missing.
  """
  runs = studies.read_sweep(folder).without_controls
  typical = replays.typical_row(runs['reward']) if 'reward' in runs else None
  if typical is None:
    raise errors.ResultsError(
        f'{folder}: no valid episode of a run named reward; must be'
        ' finished sweeps of the experiment quick'
    )
  panels = [_replay(folder, runs.get(name), typical) for name in _TITLES]
  frames = [
      _draw_frame([panel[min(step, len(panel) - 1)] for panel in panels])
      for step in range(STEPS + 1)
  ]
  _save(frames, path)


def _replay(
    folder: pathlib.Path,
    run: study.Run | None,
    like: results.EpisodeResult,
) -> list[_Moment]:
  """Returns the first moments of the episode in the same world as `like`."""
  world = (like.seed, like.world, like.episode)
  rows = [
      row
      for row in (run.rows if run else ())
      if (row.seed, row.world, row.episode) == world
  ]
  if run is None or not rows:
    raise errors.ResultsError(
        f'{folder}: no episode of the secure twin with (seed, world, episode)'
        f' {world}; must be finished sweeps of the experiment quick'
    )
  moments: list[_Moment] = []

  def start(env: environment.Environment, stack: contextlib.ExitStack) -> Any:
    del stack
    view = views.View(env, _PANEL, _POSE)
    base = env.mechanism.registers['reward'].blocks[0].geom

    def add(physics: Any, track: tracking.Track) -> None:
      if track.num_steps <= STEPS:
        moments.append(
            _Moment(
                view.frame(),
                view.place_of(physics.bind(base).xpos),
                track.true_return,
                track.observed_return,
                _note(track),
            )
        )

    return add

  replays.replay(run, rows[0], start)
  return moments


def _note(track: tracking.Track) -> str:
  """Returns the line below the figures of a control step."""
  if track.true_rewards and track.true_rewards[-1] >= _LARGE_APPLE:
    return 'takes the large apple: the episode ends'
  reward = track.registers['reward']
  error = reward.reading[-1] - reward.clean[-1]
  if abs(error) < 0.5:
    return ''
  side = 'high' if error > 0 else 'low'
  return f'base block moved: reading {abs(error):.0f} too {side}'


def _draw_frame(moments: Sequence[_Moment]) -> Image.Image:
  """Returns a frame of the picture."""
  image = Image.new('RGB', SIZE, _BACKGROUND)
  draw = ImageDraw.Draw(image)
  pairs = zip(_TITLES.values(), moments, strict=True)
  for number, (title, moment) in enumerate(pairs):
    left = number * (_PANEL[0] + _GAP)
    middle = left + _PANEL[0] / 2
    image.paste(moment.view, (left, _HEAD))
    _write(draw, (middle, _HEAD / 2), title, _PLAIN, 20, 'mm')
    x, y = left + moment.base[0], _HEAD + moment.base[1]
    draw.circle((x, y), _RING, outline='white', width=2)
    top = _HEAD + _PANEL[1]
    for line, (name, value, colour) in enumerate(
        (
            ('observed return', moment.observed_return, _OBSERVED),
            ('true return', moment.true_return, _TRUE),
        )
    ):
      y = top + 22 + 28 * line
      _write(draw, (middle - 6, y), name, colour, 20, 'rm')
      _write(draw, (middle + 6, y), f'{value:,.0f}', colour, 26, 'lm')
    _write(draw, (middle, top + 82), moment.note, _PLAIN, 18, 'mm')
  return image


def _write(
    draw: ImageDraw.ImageDraw,
    position: tuple[float, float],
    text: str,
    colour: tuple[int, int, int],
    size: int,
    anchor: str,
) -> None:
  font = ImageFont.load_default(size)
  draw.text(position, text, fill=colour, font=font, anchor=anchor)


def _save(frames: Sequence[Image.Image], path: pathlib.Path) -> None:
  """Writes frames as a GIF that repeats."""
  # Each colour counts once in the palette, otherwise small objects get the
  # colours of the floor. One palette, so that resting pixels do not change.
  pixels = np.concatenate([np.asarray(frames[0]), np.asarray(frames[-1])])
  colours = np.unique(pixels.reshape(-1, 3), axis=0)[np.newaxis]
  palette = Image.fromarray(colours).quantize(_COLOURS)
  plain = Image.Dither.NONE
  first, *others = [f.quantize(palette=palette, dither=plain) for f in frames]
  first.save(
      path,
      save_all=True,
      append_images=others,
      duration=[100] * len(others) + [LAST_FRAME_MS],
      loop=0,
  )
