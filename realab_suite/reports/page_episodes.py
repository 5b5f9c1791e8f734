"""Typical episodes in the page of a report: their paths, and films."""

from collections.abc import Callable, Sequence
import contextlib
import dataclasses
import io
import pathlib
import tempfile
from typing import Any, final

from realab_suite import errors
from realab_suite.evaluation import results
from realab_suite.lab.experiments import replays
from realab_suite.lab.experiments import sweep_results
from realab_suite.reports import numbers
from realab_suite.reports import plots


@final
@dataclasses.dataclass(frozen=True)
class Clip:
  """A film in the page.

  Attributes:
    run: Run that the film shows.
    note: Figures of the episode.
    uri: Data URI of the film.
    poster: Data URI of its last frame, for printed pages.
  """

  run: str
  note: str
  uri: str
  poster: str


def paths(
    learned: Sequence[numbers.Figures],
) -> tuple[plots.Picture | None, str | None]:
  """Returns a picture of typical episodes, and a problem.

  Either may be `None`. The problem is the error of the last run whose episode
  could not be replayed.
  """
  tracks, problem = {}, None
  for one in learned:
    if row := replays.typical_row(one.run):
      try:
        tracks[one.run.name] = replays.replay(one.run, row)
      except errors.RealabError as error:
        problem = f'{one.run.name}: {error}'
  if not tracks:
    return None, problem
  file = io.BytesIO()
  plots.draw_trajectories(tracks, file)
  picture = plots.Picture(
      'Typical episodes',
      'Path of the agent and final positions of the blocks, in the episode of'
      ' median corruption of each design.',
      plots.data_uri('image/png', file.getvalue()),
  )
  return picture, problem


def clips(
    learned: Sequence[numbers.Figures], say: Callable[[str], None]
) -> tuple[list[Clip], str | None]:
  """Returns films of some episodes, and a problem or `None`.

  The problem is the error of the last episode that could not be filmed.

  Args:
    learned: Runs to film, one episode of each.
    say: Called with a line on each film.
  """
  films, problem = [], None
  for one in learned:
    row = replays.typical_row(one.run) or replays.first_row(one.run)
    if row is None:
      continue
    say(f'{one.run.name}: filming a typical episode')
    try:
      films.append(_clip(one.run, row))
    except errors.RealabError as error:
      problem = f'{one.run.name}: {error}'
  return films, problem


def _clip(run: sweep_results.Run, row: results.EpisodeResult) -> Clip:
  from realab_suite.reports import films  # Needs a renderer.

  with tempfile.TemporaryDirectory() as folder:
    path = pathlib.Path(folder) / 'clip.mp4'

    def film(env: Any, stack: contextlib.ExitStack) -> Any:
      # Halves the time per frame, without a visible difference in a clip.
      env.physics.model.vis.quality.offsamples = 0
      return stack.enter_context(films.film(env, path, run.name, ['top_down']))

    replays.replay(run, row, film)
    data = path.read_bytes()
    poster = films.last_frame(path)
  return Clip(
      run.name,
      f'evaluation {replays.words(row)}',
      plots.data_uri('video/mp4', data),
      plots.data_uri('image/jpeg', poster),
  )
