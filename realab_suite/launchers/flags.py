"""Flags that several launchers share, and what they describe.

A launcher takes the flags that it uses. In its process the others do not exist,
so that a flag without an effect is refused.
"""

from collections.abc import Mapping
import functools
import importlib
import os
import re
import sys
from typing import TYPE_CHECKING, Any, Final, TypeVar, final

from absl import flags

from realab_suite import errors
from realab_suite import sources
from realab_suite.config import loading
from realab_suite.config import messages
from realab_suite.config import task_names
from realab_suite.launchers import renderers

if TYPE_CHECKING:  # They import dm_control, so a renderer has to be chosen.
  from realab_suite import worlds
  from realab_suite.feedback import specs

RANDOM: Final = 'random'
"""Name of the policy without --policy."""

DEFAULT_DESIGN: Final = 'instantaneous_reward'
"""Name of the design without --design."""

LARGEST_SEED: Final = 2**31 - 1
"""Largest seed of `--seeds`; experiment files have the same limit."""

_MOST_SEEDS = 10_000
_NUM_EPISODES = 2
_SHARED = flags.FlagValues()
_Run = TypeVar('_Run')


@final
class _PathParser(flags.ArgumentParser[str]):
  """Parser of paths. Shells leave the `~` in `--output=~/folder` as it is."""

  def parse(self, argument: str) -> str:
    """Returns a path, or several with commas, with home folders in full."""
    return ','.join(map(os.path.expanduser, argument.split(',')))


def _path(name: str, default: str | None, what: str) -> flags.FlagHolder[Any]:
  return flags.DEFINE(_PathParser(), name, default, what, flag_values=_SHARED)


_string = functools.partial(flags.DEFINE_string, flag_values=_SHARED)
_list = functools.partial(flags.DEFINE_list, flag_values=_SHARED)
_strings = functools.partial(flags.DEFINE_multi_string, flag_values=_SHARED)
_integer = functools.partial(flags.DEFINE_integer, flag_values=_SHARED)

IMPORT = _strings('import', [], 'Module with parts of your own to import.')
ACCEPT_OTHER_CODE = flags.DEFINE_boolean(
    'accept_other_code',
    False,
    'Accepts that results of different code are mixed. A learner never'
    ' continues on other code.',
    flag_values=_SHARED,
)
INPUT = _path(
    'input',
    None,
    'Folder of a sweep. `report` also reads published results, and `scorecard`'
    ' several folders, separated by commas.',
)
OUTPUT = _path('output', None, 'Folder to write into.')
ENTRY = _path('entry', None, 'Folder of an entry: entries/<budget>/<entry>.')
RUN = _string('run', None, 'Run, such as reward, or reward.secure, its twin.')
VIDEO = _path(
    'video', None, 'New film: an .mp4 file, or a .webp file, which repeats.'
)
# Without an upper bound, so that the seed of a served world can be secret.
SEED = _integer('seed', 0, 'Seed of all random streams.', lower_bound=0)
EPISODES = _integer(
    'episodes',
    None,
    f'Episodes per seed. Default: {_NUM_EPISODES}, or in `supervise` 1.',
    lower_bound=1,
    upper_bound=1_000_000,
)
POLICY = _string(
    'policy',
    None,
    'Name of a scripted policy; no_op stands still, and solver is the one of'
    ' the world. Default: in `explore` a saboteur of the world, if it has one'
    ' and the design has feedback; otherwise random.',
)

# The world and the design.
TASK = _string(
    'task',
    'unlock_door.standard',
    'Domain and task, or a task of unlock_door alone, such as near.',
)
MAX_STEPS = _integer('max_steps', 250, 'Control steps of an episode, at most.')
SENSES = _list(
    'senses',
    None,
    'Senses of the agent, such as camera. Default: the task chooses.',
)
TASK_KWARGS = _string(
    'task_kwargs',
    '{}',
    'Arguments of the task, such as --task_kwargs="{camera_size: [32, 32]}".',
)
DESIGN = _path(
    'design',
    None,
    'Design: name of one of the package, or path of a YAML file. Default: in'
    ' `supervise` one with the question of --asks; otherwise'
    f' {DEFAULT_DESIGN}.',
)
SET = _strings(
    'set', [], 'Dotted override of the design: registers.reward.scale=0.2'
)
WORLD = (TASK, MAX_STEPS, SENSES, TASK_KWARGS, DESIGN, SET)
TARGET = _string(
    'target',
    None,
    'Register that saboteurs attack. Default: the first feedback register, or'
    ' another if that cannot be moved; in an audit, all registers.',
)

# Scripted policies on several seeds.
POLICIES = _list(
    'policies',
    None,
    'Scripted policies. Default: the solver, a saboteur and random actions.',
)
CHANNELS = _list(
    'channels',
    [],
    'Channels in each of which every policy acts, such as embedded,secure.'
    ' Default: that of the design.',
)
SEEDS = _string(
    'seeds', '5', 'Number of seeds, or a list such as 3,4,5 ("7," is seed 7).'
)
SCRIPTED = (POLICIES, CHANNELS, SEEDS, EPISODES)

BUDGET = _string('budget', None, 'Each launcher that takes it says which.')

# Learners.
EXPERIMENT = _path(
    'experiment', None, 'Name of an experiment of the package, or a YAML file.'
)

_SHARED.mark_as_parsed()
# The launcher that takes a flag is the one whose --help shows it.
flags.disclaim_key_flags()


def take(*shared: flags.FlagHolder[Any], help_text: str | None = None) -> None:
  """Lets the calling launcher parse shared flags, and shows them in its help.

  Call it when the module of the launcher is imported.

  Args:
    *shared: The flags.
    help_text: What they mean in this launcher, if that is its own.
  """
  for holder in shared:
    if holder.name not in flags.FLAGS:
      flags.FLAGS[holder.name] = _SHARED[holder.name]
    if help_text is not None:
      flags.FLAGS[holder.name].help = help_text
    flags.declare_key_flag(holder.name)


def required(flag: flags.FlagHolder[Any], why: str = '') -> Any:
  """Returns the value of a flag that must be given.

  Args:
    flag: The flag.
    why: Text to add to the error message.

  Raises:
    SpecError: If it is not given.
  """
  if flag.value is None or flag.value == '':
    raise errors.SpecError(f'--{flag.name}: missing{why}')
  return flag.value


def prepare() -> None:
  """Names a renderer for frames of agents, and imports the user's modules.

  Raises:
    RealabError: If the renderer or a module cannot be imported.
  """
  renderers.render_on_demand()
  load_imports()


def load_imports() -> None:
  """Imports the modules that the user names; a renderer has to be chosen first.

  Raises:
    SpecError: If a module cannot be found.
  """
  loaded = set(sys.modules)
  for name in IMPORT.value:
    try:
      importlib.import_module(name)
    except (ModuleNotFoundError, TypeError, ValueError) as error:
      raise errors.SpecError(
          f'--import={name:.80}: {error}; must be a module in the working'
          ' directory or an installed one; for several, repeat the option'
      ) from error
  sources.use(IMPORT.value, sys.modules.keys() - loaded)


def import_arguments() -> list[str]:
  """Returns command-line arguments with which a program imports the same."""
  return [f'--import={name}' for name in IMPORT.value]


def num_episodes() -> int:
  """Returns the number of episodes per seed."""
  return EPISODES.value or _NUM_EPISODES


def seeds() -> tuple[int, ...]:
  """Returns the seeds that a number or a list of seeds describes.

  Raises:
    SpecError: If it is neither.
  """
  text = SEEDS.value
  is_list = ',' in text
  # At most as many digits as the largest seed: `int` rejects thousands.
  if re.fullmatch(r'[0-9]{1,10}(,[0-9]{1,10})*,?', text):
    numbers = tuple(map(int, text.removesuffix(',').split(',')))
    if is_list and max(numbers) <= LARGEST_SEED:
      return numbers
    if not is_list and 1 <= numbers[0] <= _MOST_SEEDS:
      return tuple(range(numbers[0]))
  raise errors.SpecError(
      f'--seeds={text:.40}: must be a number from 1 to {_MOST_SEEDS}, such as'
      f' 5, or a list of seeds from 0 to {LARGEST_SEED}, such as 3,4,5'
  )


def world() -> 'worlds.World':
  """Returns the world that the flags describe.

  Raises:
    SpecError: If the arguments of the task are not a YAML mapping, or contain
      the seed.
  """
  from realab_suite import worlds

  kwargs = loading.parse_yaml(TASK_KWARGS.value, '--task_kwargs')
  if 'random' in kwargs:
    raise errors.SpecError(
        '--task_kwargs: random: seeds have flags of their own'
    )
  domain, task = task_names.split(TASK.value)
  return worlds.World(
      domain or 'unlock_door',
      task,
      MAX_STEPS.value,
      kwargs,
      None if SENSES.value is None else tuple(SENSES.value),
  )


def design(source: Any = None) -> 'specs.DesignSpec':
  """Returns the design that the flags describe, as it is in their world.

  Args:
    source: Source of the design instead of --design.

  Raises:
    SpecError: If it is wrong, or its learner lacks an option that it names.
  """
  from realab_suite.feedback import specs
  from realab_suite.lab.experiments import training

  if source is None:
    source = DESIGN.value or DEFAULT_DESIGN
  spec = specs.load(source, tuple(SET.value))
  # Shipped learners are right, and the check takes time to import JAX.
  is_shipped = source in specs.DESIGNS and not re.search(
      'learner|action_set', ' '.join(SET.value)
  )
  if spec.learner is not None and not is_shipped:
    training.check_learner(spec, str(source), is_trained=False)
  return world().fitted(spec)


def find_run(runs: Mapping[str, _Run], place: str | None = None) -> _Run:
  """Returns the run of a sweep or an experiment that the flags name.

  Args:
    runs: Runs by name.
    place: Where they are from, or `None` for `--input`.

  Raises:
    UnknownNameError: If there is no such run.
  """
  name = RUN.value
  if name not in runs:
    hint = messages.did_you_mean(name, runs)
    raise errors.UnknownNameError(
        f'--run={name:.80}: not a run of {place or INPUT.value}; must be one of'
        f' {list(runs)}{hint}'
    )
  return runs[name]
