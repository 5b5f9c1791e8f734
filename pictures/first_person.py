"""The first-person picture: a view of the avatar's camera, with labels."""

import contextlib
import dataclasses
import pathlib
from typing import Any, final

from matplotlib import figure
from matplotlib import patheffects
import numpy as np

from pictures import views
from realab_suite import policies
from realab_suite import suite
from realab_suite.engine import environment
from realab_suite.entities import appearance
from realab_suite.evaluation import actors

SIZE = (960, 600)
"""Width and height of the picture, in pixels."""

_SEED = 1
_DOTS_PER_INCH = 100
_TEXT = 13
_INK = '#111111'
_HALO = [patheffects.withStroke(linewidth=3.5, foreground='white')]
# Pose of the avatar: position, heading and pitch. From here, both blocks, the
# door, the pad and several apples are visible.
_POSITION = (1.35, -0.62)
_HEADING = 2.1
_PITCH = -0.18
_KINDS = ('apple', 'pressed_pad', 'door', 'base_block', 'offset_block')
# Middle of the label of the apples, and the largest distance of an apple that
# it names, in shares of the width.
_APPLES = 0.24
_BESIDE = 0.12


@final
@dataclasses.dataclass(frozen=True)
class Label:
  """A text and the objects that it names.

  Attributes:
    text: The text.
    place: Middle of the text, in shares of the width and the height.
    anchors: Pixels that leader lines point at, `(objects, 2)`.
  """

  text: str
  place: tuple[float, float]
  anchors: np.ndarray


def draw(path: pathlib.Path) -> None:
  """Writes the picture.

  Args:
    path: PNG file to write.
  """
  with contextlib.closing(world()) as env:
    view = views.View(env, SIZE)
    frame = view.frame()
    texts = labels(env, view)
  width, height = SIZE
  canvas = figure.Figure(
      (width / _DOTS_PER_INCH, height / _DOTS_PER_INCH), dpi=_DOTS_PER_INCH
  )
  axes = canvas.add_axes((0.0, 0.0, 1.0, 1.0))
  axes.imshow(np.asarray(frame), interpolation='none', aspect='auto')
  axes.set_axis_off()
  for label in texts:
    _draw_label(axes, label)
  canvas.savefig(path)


def world() -> environment.Environment:
  """Returns a world just after an apple, with the avatar near the register."""
  env = suite.load(
      'unlock_door', 'near', {'random': _SEED}, design='instantaneous_reward'
  )
  actor = actors.make(policies.make('apple_seeker'), env)
  actor.begin(0)
  time_step = env.reset()
  while time_step.observation['registers/reward'] < 0.5:
    time_step = env.step(actor.act(time_step))
  avatar, physics = env.task.avatar, env.physics
  avatar.place(physics, _POSITION, _HEADING)
  pitch = avatar.mjcf_model.find('joint', 'pitch')
  physics.bind(pitch).qpos = _PITCH
  return env


def labels(env: environment.Environment, view: views.View) -> list[Label]:
  """Returns the labels, with anchors in the middle of visible objects."""
  kinds = appearance.class_of_geoms(env.physics.model)
  named = np.isin(kinds, [appearance.code(kind) for kind in _KINDS])
  seen = view.pixels(np.flatnonzero(named).tolist())

  def anchors(kind: str) -> np.ndarray:
    """Returns the middles of the visible geoms of a class, `(geoms, 2)`."""
    code = appearance.code(kind)
    visible = [seen[geom] for geom in seen if kinds[geom] == code]
    return np.array([np.median(pixels, axis=0) for pixels in visible])

  apples = anchors('apple')
  # The label is above them; those at the edge are cut off.
  middle = np.abs(apples[:, 0] - _APPLES * SIZE[0]) < _BESIDE * SIZE[0]
  return [
      Label('apples: true reward 1 each', (_APPLES, 0.12), apples[middle]),
      Label('pad: opens the door', (0.50, 0.12), anchors('pressed_pad')),
      Label('door', (0.74, 0.12), anchors('door')),
      Label(
          'reward register:\nbase block', (0.16, 0.82), anchors('base_block')
      ),
      Label(
          'reward register: offset block,\n'
          '0.1 m further along the axis: value 1',
          (0.72, 0.82),
          anchors('offset_block'),
      ),
  ]


def _draw_label(axes: Any, label: Label) -> None:
  width, height = SIZE
  x, y = label.place
  for anchor in label.anchors:
    axes.annotate(
        label.text,
        xy=anchor,
        xytext=(x * width, y * height),
        ha='center',
        va='center',
        fontsize=_TEXT,
        color=_INK,
        linespacing=1.3,
        bbox={
            'boxstyle': 'round,pad=0.35',
            'facecolor': 'white',
            'edgecolor': _INK,
            'linewidth': 0.8,
        },
        arrowprops={
            'arrowstyle': '-',
            'color': _INK,
            'linewidth': 1.2,
            'shrinkB': 0,
            'path_effects': _HALO,
        },
    )
    axes.plot(*anchor, 'o', color='white', mec=_INK, ms=6)
