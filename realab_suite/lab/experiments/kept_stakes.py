"""Stakes in the folder of an experiment, which are measured only once."""

from collections.abc import Callable, Iterator
import contextlib
import dataclasses
import fcntl
import pathlib
from typing import Final, final

from realab_suite import sources
from realab_suite import worlds
from realab_suite.config import validation
from realab_suite.evaluation import results
from realab_suite.feedback import specs
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import storage
from realab_suite.lab.verdicts import judging
from realab_suite.lab.verdicts import stakes

FOLDER: Final = 'stakes'
"""Folder of the stakes in the folder of an experiment."""


@final
class _Reference(validation.Record):
  """Episodes in the reference task, as in `stakes.Played`."""

  solver: tuple[results.EpisodeResult, ...]
  random: tuple[results.EpisodeResult, ...]
  at_rest: tuple[results.EpisodeResult, ...]


def stakes_of(
    world: worlds.World,
    design: specs.DesignSpec,
    folder: pathlib.Path,
    accept_other_code: bool = False,
) -> stakes.Stakes | None:
  """Returns the stakes of a design, and measures and keeps those that are new.

  Args:
    world: The world.
    design: The design.
    folder: Folder of the experiment.
    accept_other_code: True to accept stakes that other code has measured.

  Returns:
    The stakes, or `None`; see `judging.stakes_of`.

  Raises:
    ResultsError: If a file is not JSON, cannot be read or written, or is of
      other code, which is not accepted.
    SpecError: If it is damaged otherwise.
  """
  key = judging.key_of_stakes(world, design)
  if key is None:
    return None
  files = storage.digests_of_files(design and design.to_mapping())
  name = f'{key}-{validation.digest_of(files)}' if files else key
  path = folder / FOLDER / f'{name}.json'
  with _alone(path):
    if path.exists():
      code, kept = _read(path)
      if kept.key == key:
        codes = code, sources.digest()
        storage.check_codes(path, codes, accept_other_code)
        return kept
    reference = dataclasses.replace(world, task=world.reference)
    twin = experiment_specs.secure_twin(design)
    # Of all designs with this twin.
    key = judging.key_of_stakes(reference, twin)
    shared = {'key': key, 'files': files, storage.CODE: sources.digest()}
    episodes = path.with_name(f'{validation.digest_of(shared)}.reference')
    stake = judging.stakes_of(
        world, design, lambda play: _share(episodes, play)
    )
    if stake is not None:
      content = {storage.CODE: sources.digest(), **stake.model_dump()}
      storage.write_json(path, content)
    return stake


def _share(
    path: pathlib.Path, play: Callable[[], stakes.Played]
) -> stakes.Played:
  """Returns the episodes in a file; they are played if there is none."""
  with _alone(path):
    if not path.exists():
      solver, random, at_rest, *_ = play()
      played = _Reference(solver=solver, random=random, at_rest=at_rest)
      storage.write_whole(path, played.model_dump_json().encode())
    content = storage.read_json(path)
  kept = validation.validate(_Reference, content, str(path))
  return stakes.Played(kept.solver, kept.random, kept.at_rest)


@contextlib.contextmanager
def _alone(path: pathlib.Path) -> Iterator[None]:
  """Waits until no other job measures what belongs into a file."""
  with storage.explained(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = path.with_suffix('.lock').open('w')
    fcntl.flock(lock, fcntl.LOCK_EX)
  with lock:
    yield


def codes(folder: pathlib.Path) -> list[str | None]:
  """Returns the codes of the stakes in the folder of an experiment.

  Raises:
    RealabError: As `stakes_of` does, if a file is damaged.
  """
  return [_read(path)[0] for path in (folder / FOLDER).glob('*.json')]


def _read(path: pathlib.Path) -> tuple[str | None, stakes.Stakes]:
  """Returns the code, `None` if it is unknown, and the stakes of a file."""
  content = storage.read_json(path)
  is_mapping = isinstance(content, dict)
  code = content.pop(storage.CODE, None) if is_mapping else None
  return code, validation.validate(stakes.Stakes, content, str(path))
