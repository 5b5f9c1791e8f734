"""Campaign C22: what a file or a flag says never leads out of where it may.

Run from the root of the repository, about a minute:

    python -m campaigns.paths_campaign

Paths that lead elsewhere (absolute ones, `..`, links, devices, URLs, NUL) are
put wherever a design, an experiment, a folder of results or a flag has a text.
Each has to be refused, and no file outside the working directory may be opened
meanwhile: Python says which are by its audit events, and `strace`, where there
is one, which the rest of the process opens. Files that users name on a command
line or in a call of their own are theirs, and are opened. Prints `C22 figure
target verdict seed`.
"""

from collections.abc import Callable, Iterator
import contextlib
import hashlib
import json
import os
import pathlib
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from typing import Any, NamedTuple

import yaml

from campaigns import figure_lines
import realab_suite
from realab_suite import errors
from realab_suite import suite
from realab_suite.experiments import experiment_specs
from realab_suite.experiments import jobs
from realab_suite.experiments import scheduler
from realab_suite.experiments import scripted
from realab_suite.experiments import storage
from realab_suite.feedback import specs
from realab_suite.policies import network_files
from realab_suite.reports import sweep_results
from tests.config import file_readers
from tests.experiments import small

OFF_LIMITS = 'off_limits'
"""The name of the folder that nothing may be opened in."""

_ACTION_SET = {'name': 'dmlab_like', 'version': 1}
_REGISTER = {
    'kind': 'two_block', 'role': 'feedback', 'place': 'station_1',
    'range': [0, 13],
}  # fmt: skip
_LINK = 'link.yaml'


class Case(NamedTuple):
  """A path somewhere."""

  name: str
  use: Callable[[], Any]


class Watch:
  """Notes which files are opened outside of some folders."""

  def __init__(self) -> None:
    self.opened: list[str] = []
    self._allowed: list[str] = []
    sys.addaudithook(self._hear)  # Stays for as long as the process.

  @contextlib.contextmanager
  def only(self, *allowed: str) -> Iterator[None]:
    """Notes what is opened outside of these, while the context lasts."""
    self.opened.clear()
    self._allowed = [os.path.realpath(path) for path in allowed]
    try:
      yield
    finally:
      self._allowed = []

  def _hear(self, event: str, arguments: Any) -> None:
    if not self._allowed or event not in ('open', 'os.listdir', 'os.scandir'):
      return
    path = arguments[0]
    if not isinstance(path, str | bytes | os.PathLike):
      return
    real = os.path.realpath(os.fsdecode(path))
    if not any(os.path.commonpath([real, a]) == a for a in self._allowed):
      self.opened.append(real)


def _design(**changes: Any) -> dict[str, Any]:
  return {
      'schema': 1,
      'name': 'd',
      'registers': {'reward': _REGISTER},
      'action_set': _ACTION_SET,
      'providers': [
          {
              'kind': 'demonstration',
              'policy': 'network_demonstrator',
              'writes': ['reward'],
          }
      ],
      'learner': {'kind': 'q_learning'},
      **changes,
  }


def _experiment(**changes: Any) -> dict[str, Any]:
  return {
      'schema': 1,
      'name': 'e',
      'task': 'unlock_door.near',
      'runs': {'one': {'design': 'online_imitation'}},
      'seeds': [0],
      **changes,
  }


def _with_weights(path: str) -> dict[str, Any]:
  return _demonstrated('network_demonstrator', {'weights': path})


def _demonstrated(policy: str, options: Any) -> dict[str, Any]:
  (provider,) = _design()['providers']
  return _design(providers=[{**provider, 'policy': policy, 'options': options}])


def _wrapped(depth: int, path: str) -> dict[str, Any]:
  """Weights in the options of so many policies around each other."""
  policy, options = 'network_demonstrator', {'weights': path}
  for _ in range(depth):
    options = {'inner': policy, 'inner_options': options}
    policy = 'test_wrapping'
  return _demonstrated(policy, options)


def _advised(function: str, options: Any) -> dict[str, Any]:
  return _design(
      registers={
          'reward': _REGISTER,
          'query': {**_REGISTER, 'role': 'query', 'place': 'station_2'},
      },
      providers=[
          {
              'kind': 'value_advice',
              'value_function': function,
              'options': options,
              'reads': ['query'],
              'writes': ['reward'],
          }
      ],
  )


def _overridden(design: Any, *overrides: str) -> Callable[[], Any]:
  """A file of a design, with overrides of the user's."""
  return _from_file(lambda name: specs.load(name, overrides), design)


def _from_file(load: Callable[[str], Any], data: Any) -> Callable[[], Any]:
  return lambda: load(_file(data))


def _file(data: Any) -> str:
  """Writes a file, without anchors, and returns its name."""
  text = json.dumps(data)
  pathlib.Path('given.yaml').write_text(text, encoding='utf-8')
  return 'given.yaml'


def _sweep(folder: str) -> Any:
  pathlib.Path('sweep').mkdir(exist_ok=True)
  if folder == _LINK and not os.path.lexists(f'sweep/{_LINK}'):
    os.symlink(os.path.abspath('linked'), f'sweep/{_LINK}')
  text = yaml.safe_dump(_experiment())
  pathlib.Path('sweep', scheduler.EXPERIMENT).write_text(text, encoding='utf-8')
  job = {
      'run': 'one', 'seed': 0, 'folder': folder, 'kind': 'q_learning',
      'is_scripted': False, 'design': 'd', 'channel': 'embedded',
      'baseline': None, 'twin_of': None,
  }  # fmt: skip
  # Whoever forges a folder forges its checksums.
  storage.write_sealed(
      pathlib.Path('sweep', scheduler.SWEEP),
      {
          'experiment': 'e', 'calibration': False, 'jobs': [job],
          'sha256': hashlib.sha256(text.encode()).hexdigest(),
      },
  )  # fmt: skip
  return sweep_results.load(pathlib.Path('sweep'))


def _done(name: str) -> Any:
  folder = pathlib.Path('done')
  folder.mkdir(exist_ok=True)
  storage.write_done(folder, {'files': {name: '0' * 64}})
  return storage.is_done(folder)


def paths(outside: pathlib.Path) -> dict[str, str]:
  """Returns paths that lead out of the working directory, by what they are."""
  os.symlink(outside / 'secret.yaml', _LINK)
  os.symlink(outside, 'linked')
  os.symlink('linked', 'twice')
  up = os.path.relpath(outside, '.')
  return {
      'absolute': str(outside / 'secret.yaml'),
      'two slashes': f'/{outside}/secret.yaml',
      'up': f'{up}/secret.yaml',
      'up and down': f'sub/../{up}/secret.yaml',
      'link': _LINK,
      'link to a folder': 'linked/secret.yaml',
      'link to a link': 'twice/secret.yaml',
      'link and up': f'linked/../{outside.name}/secret.yaml',
      'URL': f'file://{outside}/secret.yaml',
      'home': '~/.netrc',
      'device': '/dev/zero',
      'process': '/proc/self/environ',
      'folder': str(outside),
      'network': str(outside / 'secret.npz'),
      'format': '%s%n',
      'newline': 'a\n../b',
      'dots': '..',
      'home folder': '~',
      'home of another user': '~root/x.npz',
      'drive': 'C:\\x.npz',
      'drive without a folder': 'C:x.npz',
      'share': '\\\\server\\share\\x.npz',
      'up, with backslashes': f'..\\{outside.name}\\secret.npz',
      'NUL': 'a\0b',
  }


def cases(outside: pathlib.Path) -> list[Case]:
  """Returns what to try; the working directory is one to write into."""
  found = []
  here = pathlib.Path('.')
  experiment = experiment_specs.load(_experiment())
  for what, path in paths(outside).items():
    register = {**_REGISTER, 'options': {'file': path}}
    uses: dict[str, Callable[[], Any]] = {
        'design of an experiment': _from_file(
            experiment_specs.load, _experiment(runs={'one': {'design': path}})
        ),
        'weights in an override': _from_file(
            experiment_specs.load,
            _experiment(
                runs={
                    'one': {
                        'design': 'online_imitation',
                        'overrides': [
                            'providers.0.policy=network_demonstrator',
                            f'providers.0.options.weights={path!r}',
                        ],
                    }
                }
            ),
        ),
        'weights of a design': _from_file(specs.load, _with_weights(path)),
        'weights of a value function': _from_file(
            specs.load, _advised('network_values', {'weights': path})
        ),
        'weights of the policy of a value function': _from_file(
            specs.load,
            _advised(
                'apple_seeker_approval',
                {
                    'policy': 'network_demonstrator',
                    'options': {'weights': path},
                },
            ),
        ),
        **{
            f'weights, {depth} policies deep': _from_file(
                specs.load, _wrapped(depth, path)
            )
            for depth in (1, 3, 20)
        },
        'deep weights in an override': _from_file(
            experiment_specs.load,
            _experiment(
                runs={
                    'one': {
                        'design': 'value_advice',
                        'overrides': [
                            'providers.0.options.policy=network_demonstrator',
                            f'providers.0.options.options.weights={path!r}',
                        ],
                    }
                }
            ),
        ),
        'weights that an override makes a path': _overridden(
            _demonstrated('test_any_option', {'weights': path}),
            'providers.0.policy=network_demonstrator',
        ),
        'weights beside an override': _overridden(
            _wrapped(1, path), 'providers.0.options.inner_options.x=1'
        ),
        'file of a provider': _from_file(
            specs.load,
            _design(
                providers=[
                    {'kind': 'test_reading', 'writes': [], 'file': path}
                ]
            ),
        ),
        'files of a policy': _from_file(
            specs.load, _demonstrated('test_reader', {'table': {'a': [path]}})
        ),
        'file of a register': lambda register=register: _load_world(
            _file(
                _design(
                    registers={'reward': {**register, 'kind': 'test_reading'}},
                    providers=[],
                )
            )
        ),
        'name of an experiment': _from_file(
            experiment_specs.load, _experiment(name=path)
        ),
        'name of a run': _from_file(
            experiment_specs.load,
            _experiment(runs={path: {'design': 'online_imitation'}}),
        ),
        'task': _from_file(experiment_specs.load, _experiment(task=path)),
        'baseline': _from_file(
            experiment_specs.load, _experiment(baselines=[path])
        ),
        'name of a design': _from_file(specs.load, _design(name=path)),
        'name of a register': _from_file(
            specs.load, _design(registers={path: _REGISTER})
        ),
        'kind of a register': _from_file(
            specs.load,
            _design(registers={'reward': {**_REGISTER, 'kind': path}}),
        ),
        'option of a register': lambda register=register: _load_world(
            _design(registers={'reward': register}, providers=[])
        ),
        'place': lambda path=path: _load_world(
            _design(
                registers={'reward': {**_REGISTER, 'place': path}}, providers=[]
            )
        ),
        'model in a design': _from_file(specs.load, _design(model=path)),
        'folder of a job': lambda path=path: _sweep(path),
        'result of a run': lambda path=path: _done(path),
        'design of a run that is over': lambda path=path: sweep_results.Run(
            'one', (), {}, (), {0: {'design': _with_weights(path)}}
        ).design,
        '--run': lambda path=path: jobs.plan(experiment, [0], [path]),
        '--policies': lambda path=path: scripted.plan(
            small.settings(here, policies=(path,))
        ),
        '--channels': lambda path=path: scripted.plan(
            small.settings(here, channels=(path,))
        ),
        '--baseline': lambda path=path: scripted.run(
            small.settings(here, baseline=path), str
        ),
        '--target': lambda path=path: scripted.run(
            small.settings(
                here, policies=('carrying_saboteur',), target=path
            ),
            str,
        ),
    }  # fmt: skip
    found += [Case(f'{place}: {what}', use) for place, use in uses.items()]
  return found


def _load_world(design: Any) -> Any:
  return suite.load('unlock_door', 'near', design=design)


class Figures(NamedTuple):
  """What came of paths that lead elsewhere."""

  tried: int
  accepted: list[str]
  other_errors: list[str]
  opened: list[str]


@contextlib.contextmanager
def workplace() -> Iterator[pathlib.Path]:
  """Makes a working directory, and yields a folder that is off limits."""
  before = os.getcwd()
  with tempfile.TemporaryDirectory() as name:
    outside = pathlib.Path(name, OFF_LIMITS)
    inside = pathlib.Path(name, 'inside')
    outside.mkdir()
    (inside / 'sub').mkdir(parents=True)
    text = yaml.safe_dump(_design(providers=[]))
    (outside / 'secret.yaml').write_text(text, encoding='utf-8')
    network = network_files.load('demonstrator_v1')
    (outside / 'secret.npz').write_bytes(network.to_bytes())
    os.chdir(inside)
    try:
      yield outside
    finally:
      os.chdir(before)


def run(watch: Watch, every: int = 1) -> Figures:
  """Tries every case, or one of so many."""
  installed = [sys.prefix, sys.base_prefix, sysconfig.get_path('stdlib')]
  package = pathlib.Path(realab_suite.__file__).parents[1]
  accepted, other_errors, opened = [], [], []
  with workplace() as outside, file_readers.registered():
    given = cases(outside)[::every]
    for case in given:
      with watch.only(os.getcwd(), str(package), *installed):
        try:
          case.use()
          accepted.append(case.name)
        except errors.RealabError as error:
          if not str(error).isprintable():
            other_errors.append(f'{case.name}: {error}')
        except Exception as error:
          other_errors.append(f'{case.name}: {type(error).__name__}: {error}')
      opened += [f'{case.name}: {path}' for path in watch.opened]
  return Figures(len(given), accepted, other_errors, opened)


def traced() -> list[str]:
  """Returns what a whole run opens that is off limits, as `strace` sees it."""
  with tempfile.TemporaryDirectory() as name:
    log = pathlib.Path(name, 'log')
    code = 'from campaigns import paths_campaign as c; c.run(c.Watch(), 3)'
    subprocess.run(
        ['strace', '-f', '-qq', '-e', 'trace=open,openat,openat2', '-o',
         str(log), sys.executable, '-c', code],
        check=True,
    )  # fmt: skip
    rows = log.read_text(errors='replace').splitlines()
  return [
      row
      for row in rows
      if '/dev/zero' in row or '/proc/self/environ' in row
      # Written there before anything is tried; nothing else writes.
      or ('secret.' in row and 'O_WRONLY' not in row)
  ]


def main() -> int:
  """Prints figures and returns the number of targets missed."""
  lines = figure_lines.Lines('C22', 0)
  found = run(Watch())
  lines.at_least('cases', found.tried, 40)
  lines.at_most('accepted', len(found.accepted), 0)
  lines.at_most('other errors', len(found.other_errors), 0)
  lines.at_most('opened outside', len(found.opened), 0)
  for row in (*found.accepted, *found.other_errors, *found.opened):
    print(row, file=sys.stderr)
  if shutil.which('strace'):
    rows = traced()
    lines.at_most('opened outside, as strace sees it', len(rows), 0)
    print(*rows[:9], sep='\n', file=sys.stderr)
  return lines.num_missed


if __name__ == '__main__':
  figure_lines.run(main)
