"""Films of typical episodes in the page of a report."""

from collections.abc import Callable, Iterable
import contextlib
import dataclasses
import pathlib
import tempfile
from typing import Any, final

from realab_suite import errors
from realab_suite.evaluation import results
from realab_suite.lab.experiments import replays
from realab_suite.lab.experiments import sweep_results
from realab_suite.reports import plots


@final
@dataclasses.dataclass(frozen=True)
class Clip:
  """A film in the page.

  Attributes:
    run: Run that the film shows.
    note: Figures of the episode.
    uri: Data URI of the film.
  """

  run: str
  note: str
  uri: str


def clips(
    runs: Iterable[sweep_results.Run], say: Callable[[str], None]
) -> tuple[list[Clip], str | None]:
  """Returns films of some episodes, and a problem or `None`.

  The problem is the error of the last episode that could not be filmed.

  Args:
    runs: Runs to film, one episode of each.
    say: Called with a line on each film.
  """
  films, problem = [], None
  for run in runs:
    row = replays.typical_row(run)
    if row is None:
      continue
    say(f'{run.name}: filming a typical episode')
    try:
      films.append(_clip(run, row))
    except errors.RealabError as error:
      problem = f'{run.name}: {error}'
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
    uri = plots.data_uri('video/mp4', path.read_bytes())
  return Clip(run.name, f'evaluation {replays.words(row)}', uri)
