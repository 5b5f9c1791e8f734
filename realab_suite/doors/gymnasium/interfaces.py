"""Spaces, conversions and pictures: what one world and a batch share."""

from collections.abc import Callable, Collection, Mapping
from typing import Any, Literal, TypeVar, final

from realab_suite import errors
from realab_suite.config import validation
from realab_suite.doors.gymnasium import codecs
from realab_suite.engine import agent_view
from realab_suite.engine import batch_environment
from realab_suite.engine import environment
from realab_suite.engine import gl_contexts

_CAMERA = 'top_down'
# Height and width of a frame, in pixels.
_SIZE = (240, 320)
# MuJoCo's free camera.
_FREE = -1

_T = TypeVar('_T')


@final
class Options(validation.Model):
  """Options of a world.

  Attributes:
    reward_register: Name of the register whose reading is the reward, or `None`
      for a reward of 0.0.
    flat: True for observations that are one vector for each world.
    render_mode: `'rgb_array'`, or `None`. Frames are for people.
  """

  reward_register: str | None = None
  flat: bool = False
  # Not `| None`, which the error message would leave out.
  render_mode: Literal['rgb_array', None] = None


def check_names(given: Collection[str], allowed: Collection[str]) -> None:
  """Checks the names of keyword arguments, or of options of a reset.

  The message has the words of Python, for which TorchRL looks when it tries out
  keyword arguments.

  Args:
    given: Names to check.
    allowed: Allowed names.

  Raises:
    UnknownOptionError: If a name is not allowed.
  """
  try:
    validation.check_keys(given, allowed, 'unexpected keyword argument')
  except ValueError as error:
    raise errors.UnknownOptionError(f'options: {error}') from None


def shielded(call: Callable[[], _T]) -> _T:
  """Calls a function that needs the environment, and not just its view.

  Errors keep their class and their words, but no frames of the environment.

  Args:
    call: A function of the adapter. It must not be bound to the environment,
      because this frame is in the traceback.

  Raises:
    RealabError: If the function fails; a `WorldError` for other exceptions.
  """
  problem: errors.RealabError
  try:
    return call()
  except errors.RealabError as error:
    problem = type(error)(str(error))
  except Exception:  # Drivers may raise anything.
    problem = errors.WorldError('the world failed')
  # Raised outside the `try`, so it has no context.
  raise problem


@final
class Interface:
  """The interface of a world, or of each world of a batch.

  Attributes:
    observations: Codec of observations.
    actions: Codec of actions.
    reward_key: Entry of the observation that is the reward, or `None`.
    metadata: Metadata of the environment.
    render_mode: `'rgb_array'`, or `None`.
    frame: Camera, height and width of the frames.
  """

  def __init__(
      self,
      view: agent_view.AgentView | agent_view.BatchAgentView,
      env: environment.Environment | batch_environment.BatchEnvironment,
      options: Mapping[str, Any],
  ) -> None:
    """Makes an interface.

    Args:
      view: View of the world or of the batch.
      env: The world or the batch.
      options: Values of `Options`.

    Raises:
      SpecError: If an option is invalid.
    """
    values = validation.validate(Options, options, 'options')
    spec = view.observation_spec()
    self.reward_key = codecs.reward_key(values.reward_register, spec)
    self.observations = codecs.ObservationCodec(spec, values.flat)
    self.actions = codecs.ActionCodec(view.action_spec())
    self.metadata = {
        'render_modes': ['rgb_array'],
        'render_fps': 1.0 / env.task.control_timestep,
    }
    self.render_mode = values.render_mode
    if self.render_mode is not None:
      gl_contexts.check_size(env.physics.model, *_SIZE)
    model = env.task.root_entity.mjcf_model
    has_camera = model.find('camera', _CAMERA) is not None
    self.frame = (_CAMERA if has_camera else _FREE, *_SIZE)
