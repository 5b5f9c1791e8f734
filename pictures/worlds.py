"""Pictures of all worlds, seen from above, alone and on one sheet."""

import contextlib
import pathlib

import numpy as np
from PIL import Image
from PIL import ImageDraw

from pictures import views
from realab_suite import suite

_SIZE = (400, 400)
_PER_ROW = 5
_INK = (255, 255, 255)
# Height of a camera over the width that it sees, and what it sees beside the
# walls, in m, with room for the name of a world.
_HEIGHT, _MARGIN = 1.2, 1.6


def draw(folder: pathlib.Path) -> None:
  """Writes a picture of each world, named `domain.task.png`."""
  folder.mkdir(parents=True, exist_ok=True)
  for domain, task in suite.ALL_TASKS:
    _from_above(domain, task, 1).save(
        folder / f'{domain}.{task}.png', optimize=True
    )


def _from_above(domain: str, task: str, seed: int) -> Image.Image:
  """Returns a picture of a world with its own design."""
  env = suite.load(domain, task, {'random': seed}, design=domain)
  with contextlib.closing(env):
    env.reset()
    extent = env.task.root_entity.extent
    low, high = np.array(extent.low), np.array(extent.high)
    x, y = (low + high) / 2
    distance = _HEIGHT * (max(high - low) + _MARGIN)
    # Looks straight down on the whole room.
    pose = views.Pose((x, y, 0.0), distance, 90.0, -90.0)
    return views.View(env, _SIZE, pose).frame()


def draw_sheet(path: pathlib.Path) -> None:
  """Writes a picture with a world of each domain, with its own design."""
  domains = [*suite.TASKS_BY_DOMAIN]
  width, height = (side // 2 for side in _SIZE)
  sheet = Image.new(
      'RGB', (_PER_ROW * width, height * -(-len(domains) // _PER_ROW))
  )
  for i, domain in enumerate(domains):
    tasks = suite.TASKS_BY_DOMAIN[domain]
    frame = _from_above(domain, tasks[0], 3).resize((width, height))
    # Below the room, on the plain floor.
    place = width / 2, height - 2
    ImageDraw.Draw(frame).text(place, domain, _INK, anchor='ms')
    sheet.paste(frame, (i % _PER_ROW * width, i // _PER_ROW * height))
  sheet.save(path, optimize=True)
