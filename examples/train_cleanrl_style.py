"""PPO in one file, in the style of CleanRL, on `gymnasium.make_vec`.

  python examples/train_cleanrl_style.py --steps=300000

The agent learns from the reading of the reward register. Afterwards, the
evaluation shows its observed return beside its true return, which it never
observes, and its gain: the observed return that corruption has added. This
needs the extra `gym`, and PyTorch.
"""

import argparse
from collections.abc import Sequence
import time
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import nn

from realab_suite.doors.gymnasium import evaluation

_WORLD = 'realab/UnlockDoor-near-InstantaneousReward-v3'
_OPTIONS: dict[str, Any] = {
    'overrides': ['dof=planar', 'action_set={name: dmlab_like, version: 1}'],
    'reward_register': 'reward',
    'flat': True,
}
_LEARNING_RATE = 1e-3
_NUM_STEPS = 128  # Control steps between two updates.
_NUM_EPOCHS = 6
_NUM_MINIBATCHES = 8
_GAMMA, _LAMBDA = 0.99, 0.95
_CLIP = 0.2
_ENTROPY = 0.01
_MAX_GRADIENT = 0.5


def _network(num_inputs: int, num_outputs: int, gain: float) -> nn.Sequential:
  layers = [nn.Linear(num_inputs, 64), nn.Linear(64, 64)]
  last = nn.Linear(64, num_outputs)
  for layer, one in ((layers[0], 2**0.5), (layers[1], 2**0.5), (last, gain)):
    nn.init.orthogonal_(layer.weight, one)
    nn.init.zeros_(layer.bias)
  return nn.Sequential(layers[0], nn.Tanh(), layers[1], nn.Tanh(), last)


class Agent(nn.Module):
  """Policy and values, with running statistics of the observations."""

  def __init__(self, num_inputs: int, num_actions: int) -> None:
    super().__init__()
    self.actor = _network(num_inputs, num_actions, 0.01)
    self.critic = _network(num_inputs, 1, 1.0)
    self.register_buffer('mean', torch.zeros(num_inputs))
    self.register_buffer('variance', torch.ones(num_inputs))
    self.register_buffer('count', torch.tensor(1e-4))

  def count_in(self, observations: torch.Tensor) -> None:
    """Adds observations to the running statistics."""
    total = self.count + len(observations)
    share = len(observations) / total
    delta = observations.mean(0) - self.mean
    self.variance += (
        share * (observations.var(0, unbiased=False) - self.variance)
        + share * (1 - share) * delta**2
    )
    self.mean += share * delta
    self.count.copy_(total)

  def forward(self, observations: torch.Tensor) -> Any:
    """Returns the distribution of the actions, and the values."""
    scaled = (observations - self.mean) / torch.sqrt(self.variance + 1e-8)
    scaled = scaled.clip(-10, 10)
    actions = torch.distributions.Categorical(logits=self.actor(scaled))
    return actions, self.critic(scaled).squeeze(-1)


def _advantages(
    rewards: torch.Tensor,
    values: torch.Tensor,
    ends: torch.Tensor,
    next_value: torch.Tensor,
) -> torch.Tensor:
  """Returns generalized advantages, `(steps, worlds)`.

  The time left is observed, so the time limit is an end like any other.
  """
  advantages = torch.zeros_like(rewards)
  advantage = torch.zeros_like(next_value)
  for t in reversed(range(len(rewards))):
    goes_on = 1 - ends[t]
    error = rewards[t] + _GAMMA * next_value * goes_on - values[t]
    advantage = error + _GAMMA * _LAMBDA * goes_on * advantage
    advantages[t], next_value = advantage, values[t]
  return advantages


def train(seed: int, steps: int, num_envs: int) -> Agent:
  """Returns a trained agent."""
  torch.manual_seed(seed)
  worlds = gym.make_vec(
      _WORLD,
      num_envs=num_envs,
      autoreset_mode='SameStep',
      task_kwargs={'random': seed, 'starts_beside_registers': 0.5},
      sleep=True,
      **_OPTIONS,
  )
  statistics = gym.wrappers.vector.RecordEpisodeStatistics(worlds)
  envs: Any = gym.wrappers.vector.NormalizeReward(statistics, _GAMMA)
  agent = Agent(
      envs.single_observation_space.shape[0], envs.single_action_space.n
  )
  optimizer = torch.optim.Adam(agent.parameters(), _LEARNING_RATE, eps=1e-5)
  began = time.monotonic()
  observations = torch.as_tensor(envs.reset(seed=seed)[0])
  for update in range(1, steps // (_NUM_STEPS * num_envs) + 1):
    rollout = []
    for _ in range(_NUM_STEPS):
      agent.count_in(observations)
      with torch.no_grad():
        distribution, values = agent(observations)
      actions = distribution.sample()
      found, rewards, terminated, truncated, _ = envs.step(actions.numpy())
      rollout.append(
          (
              observations,
              actions,
              distribution.log_prob(actions),
              values,
              torch.as_tensor(rewards, dtype=torch.float32),
              torch.as_tensor(terminated | truncated, dtype=torch.float32),
          )
      )
      observations = torch.as_tensor(found)
    with torch.no_grad():
      _, next_value = agent(observations)
    seen, taken, log_probs, values, rewards, ends = map(
        torch.stack, zip(*rollout, strict=True)
    )
    advantages = _advantages(rewards, values, ends, next_value)
    batch = [
        one.flatten(0, 1)
        for one in (seen, taken, log_probs, advantages, advantages + values)
    ]
    for _ in range(_NUM_EPOCHS):
      for index in torch.randperm(len(batch[0])).chunk(_NUM_MINIBATCHES):
        _learn(agent, optimizer, *(one[index] for one in batch))
    print(
        f'step {update * _NUM_STEPS * num_envs}: observed return'
        f' {np.mean(statistics.return_queue or [np.nan]):.1f},'
        f' {time.monotonic() - began:.0f} s'
    )
  envs.close()
  return agent


def _learn(
    agent: Agent,
    optimizer: torch.optim.Optimizer,
    observations: torch.Tensor,
    actions: torch.Tensor,
    log_probs: torch.Tensor,
    advantages: torch.Tensor,
    returns: torch.Tensor,
) -> None:
  """Makes one step of the optimizer, with a minibatch."""
  distribution, values = agent(observations)
  ratio = (distribution.log_prob(actions) - log_probs).exp()
  scaled = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
  gain = torch.min(ratio * scaled, ratio.clip(1 - _CLIP, 1 + _CLIP) * scaled)
  error = (values - returns) ** 2
  bonus = _ENTROPY * distribution.entropy()
  loss = (0.5 * error - gain - bonus).mean()
  optimizer.zero_grad()
  loss.backward()
  nn.utils.clip_grad_norm_(agent.parameters(), _MAX_GRADIENT)
  optimizer.step()


def main(arguments: Sequence[str] | None = None) -> None:
  """Trains an agent, and shows what it never observes."""
  parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
  parser.add_argument('--steps', type=int, default=300_000)
  parser.add_argument('--num_envs', type=int, default=64)
  parser.add_argument('--seed', type=int, default=0)
  parser.add_argument('--episodes', type=int, default=10)
  given = parser.parse_args(arguments)
  agent = train(given.seed, given.steps, given.num_envs)

  @torch.no_grad()
  def policy(observation: np.ndarray) -> int:
    distribution, _ = agent(torch.as_tensor(observation))
    return int(distribution.sample())

  env = gym.make(_WORLD, task_kwargs={'random': 10_000}, **_OPTIONS)
  results = evaluation.evaluate(env, policy, given.episodes)
  env.close()
  gains = [one.objective['return'].gain for one in results]
  print('episode  observed return  true return     gain')
  for one, gain in zip(results, gains, strict=True):
    print(
        f'{one.episode:7}  {one.observed_return:15.1f}  {one.true_return:11.1f}'
        f'  {gain:7.1f}'
    )
  print(
      f'mean     {np.mean([one.observed_return for one in results]):15.1f}'
      f'  {np.mean([one.true_return for one in results]):11.1f}'
      f'  {np.mean(gains):7.1f}'
  )


if __name__ == '__main__':
  main()
