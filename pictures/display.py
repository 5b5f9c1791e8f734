"""The display: what is seen from its reading point, and by whom it is faked."""

import contextlib
import importlib
import pathlib
from typing import Any, NamedTuple, final

from matplotlib import figure
import numpy as np

from pictures import carrying
from pictures import views
from realab_suite import suite
from realab_suite.engine import environment
from realab_suite.entities import registers

SIZE = (1200, 420)
"""Width and height of the picture, in pixels."""

_DOTS_PER_INCH = 100
_FRAME = (390, 300)
_POSE = views.Pose((1.2, -1.65, 0.5), 3.7, 112.0, -28.0)
_PLACE = np.array([0.5, -2.2, 0.0])
_TITLE = 'A display of six tiles, read from a point in front of it'
_INK = '#222222'
_CLEAR, _HIDDEN = '#F0E442', '#D55E00'
_DESIGN: Any = {
    'schema': 1,
    'name': 'shown',
    'registers': {
        'reward': {
            'kind': 'display',
            'role': 'feedback',
            'place': _PLACE[:2].tolist(),
            'range': [0, 63],
            'initial': 0,
        }
    },
}
_VALUE = 38.0


@final
class _Scene(NamedTuple):
  """A scene.

  Attributes:
    title: Description.
    avatar: Place of the avatar, relative to the display, `(x, y)`, in m.
    turn: Angle by which the display is turned, in rad.
  """

  title: str
  avatar: tuple[float, float]
  turn: float = 0.0


_SCENES = (
    _Scene('1  Nothing is in the way.', (-0.7, 1.2)),
    _Scene('2  The avatar stands in front.', (0.88, 0.42)),
    _Scene('3  The display has been turned.', (-0.4, 0.9), 0.35),
)


def draw(path: pathlib.Path) -> None:
  """Writes the picture.

  Args:
    path: PNG file to write.
  """
  importlib.import_module('examples.display')  # It adds the kind.
  width, height = (pixels / _DOTS_PER_INCH for pixels in SIZE)
  canvas = figure.Figure(
      (width, height), dpi=_DOTS_PER_INCH, layout='constrained'
  )
  canvas.suptitle(_TITLE, fontsize=14, weight='bold', color=_INK)
  world = suite.load('unlock_door', 'standard', {'random': 4}, design=_DESIGN)
  with contextlib.closing(world) as env:
    env.reset()
    view = views.View(env, _FRAME, _POSE)
    axes: Any = canvas.subplots(1, len(_SCENES))
    for ax, scene in zip(axes, _SCENES, strict=True):
      _draw(ax, env, view, scene)
  canvas.savefig(path)


def _draw(
    ax: Any, env: environment.Environment, view: views.View, scene: _Scene
) -> None:
  """Draws a scene with its lines of sight, and the values below it."""
  physics, display = env.thin_physics, env.mechanism.registers['reward']
  base = display.blocks[0]
  base.put(physics, np.array([0.0, 0.0, base.rest_height]), scene.turn)
  display.write(physics, _VALUE)
  env.task.avatar.place(physics, _PLACE[:2] + scene.avatar, np.pi / 2)
  ax.imshow(np.asarray(view.frame()), interpolation='antialiased')
  ax.set(xticks=[], yticks=[], xlim=(0, _FRAME[0]), ylim=(_FRAME[1], 0))
  point = np.array([0.77, 1.5, 1.8])
  for i, is_hidden in enumerate(_hidden(physics, display)):
    aim = np.array([0.22 * (i + 1), 0.0, 0.254])
    ends = np.transpose([view.place_of(_PLACE + end) for end in (point, aim)])
    colour = _HIDDEN if is_hidden else _CLEAR
    ax.plot(*ends, color=colour, linewidth=1.2)
  ax.plot(*view.place_of(_PLACE + point), 'o', color=_INK, markersize=6)
  ax.set_title(scene.title, fontsize=13, loc='left', color=_INK)
  read = display.inspect(physics)
  for x, text, colour in (
      (0.0, f'applied {display.applied(physics):g}', carrying.APPLIED),
      (0.34, f'reading {read.reading:g}', carrying.READING),
  ):
    ax.text(
        x, -0.03, text, transform=ax.transAxes, color=colour, fontsize=13,
        va='top', weight='bold',
    )  # fmt: skip


def _hidden(physics: Any, display: registers.Register) -> np.ndarray:
  """Returns True for lines of sight in which something is, `(tiles,)`."""
  found: list[np.ndarray] = []

  def remember(geoms: np.ndarray) -> np.ndarray:
    found.append(geoms >= 0)
    return found[-1]

  display.read_without(physics, remember)
  return found[0]
