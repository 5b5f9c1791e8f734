"""Pictures of all kinds of registers, each in an empty room."""

import contextlib
import pathlib

from pictures import views
from realab_suite import suite
from realab_suite.feedback import register_kinds

_SIZE = (400, 300)
# From the south, above the avatar.
_POSE = views.Pose((0.2, 2.0, 0.0), 2.2, 90.0, -40.0)


def draw(folder: pathlib.Path) -> None:
  """Writes a picture of each kind with blocks, which contains 3."""
  folder.mkdir(parents=True, exist_ok=True)
  kinds = register_kinds.REGISTER_KINDS
  for kind in (one for one in kinds if kinds.get(one).HAS_BLOCKS):
    design = {
        'schema': 1,
        'name': 'shown',
        'registers': {
            'shown': {
                'kind': kind,
                'role': 'feedback',
                'place': [0.0, 2.0],
                'range': [0, 8],
                'initial': 3,
            }
        },
    }
    env = suite.load('hidden_goal', 'standard', {'random': 1}, design=design)
    with contextlib.closing(env):
      env.reset()
      frame = views.View(env, _SIZE, _POSE).frame()
    frame.save(folder / f'{kind}.png', optimize=True)
