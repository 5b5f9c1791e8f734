"""Served world, which connects the agent's port with the evaluator."""

from collections.abc import Callable
import os
from typing import final

from absl import logging

from realab_suite.engine import agent_view
from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.engine import seeding
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import results
from realab_suite.interop.rpc import agent_port
from realab_suite.interop.rpc import sockets

OnEpisode = Callable[[evaluate.EpisodeResult, str], None]

_ROOT = 0


@final
class ServedWorld:
  """World that answers an agent's requests and reports episode results.

  All calls come from the thread that runs the server.
  """

  def __init__(
      self,
      env: environment.Environment,
      address: str,
      num_episodes: int,
      on_episode: OnEpisode,
  ) -> None:
    """Makes a served world; its first episode begins with the first step.

    Args:
      env: The environment. The caller closes it. Results of tier T2 require a
        `SaltedSeed`.
      address: Address of the server.
      num_episodes: Number of episodes to serve.
      on_episode: Function that is called with the result and the isolation tier
        of each episode.
    """
    self._env = env
    self._address = address
    self._num_left = num_episodes
    self._on_episode = on_episode
    self._failures: list[Exception] = []
    self._collector = evaluate.ResultCollector(env)
    self._port = agent_port.AgentPort(
        agent_view.AgentView(env, self._failures), env.abandon
    )
    self._isolation = results.SERVED

  def connect(self) -> None:
    """Handles a new connection; no other agent connects until `disconnect`."""
    users = sockets.users_connected_to(self._address)
    # Root can read everything, and the same user can read this process. Without
    # a salt, the episodes can be computed from the public seed.
    is_apart = (
        users
        and not users & {_ROOT, os.getuid()}
        and isinstance(self._env.seed, seeding.SaltedSeed)
    )
    self._isolation = (
        results.SERVED_TO_ANOTHER_USER if is_apart else results.SERVED
    )

  def answer(self, request: bytes) -> bytes:
    """Returns the answer to a request of the agent."""
    if self._num_left <= 0:
      self._port.finish()
    return self._port.answer(request)

  def disconnect(self) -> None:
    """Handles the end of a connection, by the agent or by its timeout."""
    self._port.disconnect()
    self._env.abandon(events.End.DISCONNECT)

  def settle(self) -> bool:
    """Reports ended episodes; returns True if there are more to serve."""
    for failure in self._failures:
      logging.error('the episode failed', exc_info=failure)
    self._failures.clear()
    for result in self._collector.take():
      self._num_left -= 1
      self._on_episode(result, self._isolation)
    return self._num_left > 0
