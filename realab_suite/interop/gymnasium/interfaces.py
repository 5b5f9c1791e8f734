"""Spaces, conversions and pictures: what one world and a batch share."""

from typing import Any, final

from dm_control import composer

from realab_suite import errors
from realab_suite.config import messages
from realab_suite.engine import agent_view
from realab_suite.engine import arguments
from realab_suite.interop.gymnasium import codecs

RENDER_MODES = ('rgb_array',)
"""Modes in which people can watch a world."""

_DEFAULT = 'top_down'
# MuJoCo's free camera.
_FREE = -1


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
      task: composer.Task,
      *,
      reward_register: str | None = None,
      dtype: codecs.DType = 'float32',
      flat: bool = False,
      render_mode: str | None = None,
      camera_name: str | None = None,
      height: int = 240,
      width: int = 320,
  ) -> None:
    """Makes an interface.

    Args:
      view: View of the world or of the batch.
      task: Its task.
      reward_register: Name of the register whose reading is the reward, or
        `None` for a reward of 0.0.
      dtype: Type of floats in observations and actions.
      flat: True for observations that are one vector for each world.
      render_mode: `'rgb_array'`, or `None`. Frames are for people.
      camera_name: Camera of the frames; `None` for `'top_down'`, or a free
        camera in a single world without it.
      height: Height of a frame, in pixels.
      width: Width of a frame, in pixels.

    Raises:
      SpecError: If an argument is invalid.
    """
    spec = view.observation_spec()
    self.reward_key = codecs.reward_key(reward_register, spec)
    self.observations = codecs.ObservationCodec(spec, dtype, flat)
    self.actions = codecs.ActionCodec(view.action_spec(), dtype)
    self.metadata = {
        'render_modes': list(RENDER_MODES),
        'render_fps': 1.0 / task.control_timestep,
    }
    self.render_mode = _checked_render_mode(render_mode)
    camera = _checked_camera(camera_name, task.root_entity.mjcf_model)
    self.frame = (camera, height, width)


def _checked_render_mode(given: Any) -> str | None:
  """Returns a render mode.

  Raises:
    SpecError: If there is no such mode.
  """
  if given is not None and given not in RENDER_MODES:
    raise errors.SpecError(
        f'render_mode: {messages.quote(given)}; allowed are None and'
        f' {list(RENDER_MODES)}'
    )
  return None if given is None else str(given)


def _checked_camera(given: Any, mjcf_model: Any) -> str | int:
  """Returns a camera: its name, or -1 for a free camera.

  Raises:
    SpecError: If there is no such camera.
  """
  if given is not None:
    return arguments.camera(given, mjcf_model)
  return _FREE if mjcf_model.find('camera', _DEFAULT) is None else _DEFAULT
