"""Films of episodes: a strip of figures above views of the world.

Films are for people; cameras of agents are not used here.
"""

from collections.abc import Callable, Iterator, Sequence
import contextlib
import os
import pathlib
from typing import Any

from dm_control.mujoco import engine
from imageio import v3 as imageio
from imageio.plugins import pyav
import numpy as np
from PIL import Image
from PIL import ImageDraw
from PIL import ImageFont

from realab_suite import errors
from realab_suite.engine import environment
from realab_suite.entities import protocols
from realab_suite.lab.experiments import tracking

HEIGHT = 480
"""Height of every view, in pixels."""

WIDTHS = {'top_down': 480, 'first_person': 640}
"""Width of each view in pixels, from left to right."""

OnStep = Callable[[Any, tracking.Track], None]
"""Function that is called with the physics and the track at each step."""

# The same frames give the same bytes, whatever the processors and their number.
# Without `cpu-independent`, they do not even on one machine.
_SAME_BYTES = 'threads=1:lookahead-threads=1:cpu-independent=1'
# Codec of each kind of file, its options, and those of the container.
_CODECS: dict[str, tuple[str, dict[str, str], dict[str, str]]] = {
    '.mp4': ('libx264', {'x264-params': _SAME_BYTES}, {}),
    # Repeats without end.
    '.webp': ('libwebp_anim', {}, {'loop': '0'}),
}
_BACKGROUND = (24, 28, 36)
_PLAIN = (235, 238, 242)
_FAINT = (150, 158, 170)
_CLEAN = (120, 190, 255)
_READ = (255, 160, 40)
_MARGIN = 12
_GAP = 4  # Even, as the codec demands of widths.
_HEADER = 60
_LANE = 70
# Width of the name and the two values left of the curves of a register.
_LABELS = 160
_LARGE, _SMALL = 18, 16
# In narrower strips, letters are smaller.
_ROOMY, _NARROWER = 400, 0.8


def panel(
    env: environment.Environment,
    title: str,
    views: Sequence[str],
    share: float = 1.0,
) -> Callable[[tracking.Track], np.ndarray]:
  """Returns a function that draws a strip above views of the world.

  Args:
    env: Environment to draw.
    title: Title in the strip.
    views: Names of the views, from left to right; see `WIDTHS`.
    share: Height and width of the views, as a share of `HEIGHT` and `WIDTHS`.
  """
  identifiers = {
      'top_down': 'top_down',
      'first_person': env.task.avatar.camera.full_identifier,
  }
  cameras = [
      engine.Camera(
          env.physics,
          round(share * HEIGHT),
          round(share * WIDTHS[view]),
          identifiers[view],
      )
      for view in views
  ]

  def draw(track: tracking.Track) -> np.ndarray:
    env.thin_physics.refresh()
    picture = np.concatenate([one.render() for one in cameras], axis=1)
    strip = draw_strip(title, track, picture.shape[1])
    # Players show their controls over the lower edge of a paused film.
    return np.concatenate([strip, picture], axis=0)

  return draw


@contextlib.contextmanager
def film(
    env: environment.Environment,
    path: str | os.PathLike[str],
    title: str,
    views: Sequence[str] = ('top_down', 'first_person'),
    beside: Sequence[np.ndarray] = (),
    share: float = 1.0,
) -> Iterator[OnStep]:
  """Opens a film; yields a function for `tracking.Tracker`, which adds a frame.

  The film has one frame per control step, and is played in real time. It is an
  H.264 film or an animated picture in WebP, which repeats.

  Args:
    env: Environment to film.
    path: New file, whose name ends in `.mp4` or `.webp`.
    title: Title in the strip.
    views: Names of the views, from left to right; see `WIDTHS`.
    beside: Frames of another episode, made by `panel`, to show on the left. The
      last frame of the shorter episode stays until the other one ends.
    share: As in `panel`.

  Raises:
    ResultsError: If the name has another end, or the file exists or cannot be
      created.
  """
  suffix = pathlib.Path(path).suffix
  if suffix not in _CODECS:
    raise errors.ResultsError(
        f'film {os.fspath(path)}: the name ends in {suffix!r}; must end in'
        f' one of {list(_CODECS)}'
    )
  codec, codec_options, options = _CODECS[suffix]
  try:
    pathlib.Path(path).parent.mkdir(parents=True, exist_ok=True)
    # The video library would overwrite an existing file.
    open(path, 'x', encoding='utf-8').close()
  except OSError as error:
    raise errors.ResultsError(
        f'cannot create {os.fspath(path)}: {error.strerror}'
    ) from error
  with contextlib.ExitStack() as stack:
    # A leftover empty file would prevent a rerun of the same command.
    stack.callback(os.remove, path)
    draw = panel(env, title, views, share)
    file = imageio.imopen(
        pathlib.Path(path), 'w', plugin=pyav.PyAVPlugin, options=options
    )
    stack.callback(file.close)
    file.init_video_stream(
        codec, fps=1 / env.control_timestep(), pixel_format='yuv420p'
    )
    # imageio passes options to containers only, where x264 never sees them.
    stream: Any = file._video_stream
    stream.options = codec_options
    stack.pop_all()

  frame: np.ndarray | None = None
  number = 0

  def write(right: np.ndarray) -> None:
    nonlocal number
    panels = [right]
    if beside:
      gap = np.full((len(right), _GAP, 3), _BACKGROUND, np.uint8)
      panels = [beside[min(number, len(beside) - 1)], gap, right]
    file.write_frame(np.concatenate(panels, axis=1))
    number += 1

  def add(unused_physics: protocols.Physics, track: tracking.Track) -> None:
    nonlocal frame
    frame = draw(track)
    write(frame)

  try:
    with contextlib.closing(file):
      yield add
      while frame is not None and number < len(beside):
        write(frame)
  except BaseException:
    if frame is None:
      os.remove(path)
    raise


def draw_strip(title: str, track: tracking.Track, width: int) -> np.ndarray:
  """Draws returns, clean contents and readings, as `(height, width, 3)`."""
  feedback = track.feedback
  image = Image.new(
      'RGB', (width, _HEADER + _LANE * len(feedback)), _BACKGROUND
  )
  draw = ImageDraw.Draw(image)
  right = width - _MARGIN
  observed = f'observed return {track.observed_return:.1f}'
  for position, text, colour, anchor in (
      ((_MARGIN, 8), title, _PLAIN, 'la'),
      ((right, 8), f'{track.times[-1]:.1f} s', _FAINT, 'ra'),
      ((_MARGIN, 34), f'true return {track.true_return:.1f}', _CLEAN, 'la'),
      ((right, 34), observed, _READ, 'ra'),
  ):
    _write(draw, position, text, colour, _LARGE, anchor)
  for i, (name, register) in enumerate(feedback.items()):
    _draw_lane(draw, _HEADER + i * _LANE, name, register, track, width)
  return np.asarray(image)


def _draw_lane(
    draw: ImageDraw.ImageDraw,
    top: int,
    name: str,
    register: tracking.RegisterTrack,
    track: tracking.Track,
    width: int,
) -> None:
  """Draws the values of one register, as numbers and as curves."""
  clean, read = np.array(register.clean), np.array(register.reading)
  _write(draw, (_MARGIN, top), name, _FAINT, _SMALL)
  for line, (label, values, colour) in enumerate(
      (('clean', clean, _CLEAN), ('read', read, _READ)), start=1
  ):
    y = top + 20 * line
    _write(draw, (_MARGIN, y), label, colour, _SMALL)
    value = f'{values[-1]:.2f}'
    _write(draw, (_LABELS - 20, y), value, colour, _SMALL, anchor='ra')
  both = np.concatenate([clean, read, [0.0]])
  low, high = np.nanmin(both), np.nanmax(both)
  lowest, highest = top + _LANE - 14, top + 6
  length = max(track.max_steps or track.num_steps, 1)
  x = _LABELS + np.arange(len(read)) / length * (width - _MARGIN - _LABELS)

  def curve(values: np.ndarray) -> list[tuple[float, float]]:
    share = (values - low) / max(high - low, 1.0)
    y = lowest + share * (highest - lowest)
    is_finite = np.isfinite(y)
    return list(zip(x[is_finite], y[is_finite], strict=True))

  zero = curve(np.zeros_like(read))[0][1]
  draw.line([(_LABELS, zero), (width - _MARGIN, zero)], fill=(70, 78, 92))
  draw.line(curve(clean), fill=_CLEAN, width=4)
  draw.line(curve(read), fill=_READ, width=2)


def _write(
    draw: ImageDraw.ImageDraw,
    position: tuple[int, int],
    text: str,
    colour: tuple[int, int, int],
    size: int,
    anchor: str = 'la',
) -> None:
  is_narrow = draw.im.size[0] < _ROOMY
  font = ImageFont.load_default(size * _NARROWER if is_narrow else size)
  draw.text(position, text, fill=colour, font=font, anchor=anchor)
