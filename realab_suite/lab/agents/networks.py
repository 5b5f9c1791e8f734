"""Small networks for vectors and images, and distributions over actions."""

from collections.abc import Callable
import functools
import math
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from realab_suite.lab.agents import features

# Channels and stride of each convolution. Kernels have twice the stride.
_CONVOLUTIONS = ((16, 4), (32, 2))


@final
class Linear(eqx.Module):
  """Linear layer with orthogonal initial weights.

  Inputs may have any number of leading axes.
  """

  weight: jax.Array
  bias: jax.Array

  def __init__(
      self,
      size_in: int,
      size_out: int,
      scale: float,
      generator: np.random.Generator,
  ) -> None:
    self.weight = _orthogonal((size_in, size_out), scale, generator)
    self.bias = jnp.zeros(size_out)

  def __call__(self, x: jax.Array) -> jax.Array:
    return x @ self.weight + self.bias


@final
class Convolutions(eqx.Module):
  """Two convolutions from an image of bytes to a vector.

  Images have shape `(..., height, width, channels)`, outputs `(..., size)`.
  """

  kernels: list[jax.Array]
  biases: list[jax.Array]

  def __init__(self, channels: int, generator: np.random.Generator) -> None:
    self.kernels, self.biases = [], []
    for width, stride in _CONVOLUTIONS:
      shape = (2 * stride, 2 * stride, channels, width)
      self.kernels.append(_orthogonal(shape, math.sqrt(2), generator))
      self.biases.append(jnp.zeros(width))
      channels = width

  @staticmethod
  def output_size(height: int, width: int) -> int:
    """Returns the length of the output for images of a size in pixels."""
    for _, stride in _CONVOLUTIONS:
      height, width = -(-height // stride), -(-width // stride)
    return height * width * _CONVOLUTIONS[-1][0]

  def __call__(self, image: jax.Array) -> jax.Array:
    lead = image.shape[:-3]
    x = image.reshape(-1, *image.shape[-3:]).astype(jnp.float32) / 255.0
    for kernel, bias in zip(self.kernels, self.biases, strict=True):
      x = jax.nn.relu(convolve(x, kernel) + bias)
    return x.reshape(*lead, -1)


def convolve(x: jax.Array, kernel: jax.Array) -> jax.Array:
  """Convolves images with a kernel whose stride is half of its size.

  The padding is that of `'SAME'`. On CPUs, products of matrices are much faster
  than `jax.lax.conv_general_dilated` within the loop of an update.

  Args:
    x: Images, `(images, height, width, channels)`.
    kernel: Weights, `(2 * stride, 2 * stride, channels, outputs)`.

  Returns:
    Images, `(images, rows, columns, outputs)`; rows and columns are those of
    the image divided by the stride, rounded up.
  """
  size, _, channels, outputs = kernel.shape
  stride = size // 2
  rows, columns = (-(-length // stride) for length in x.shape[1:3])
  padding = [(0, 0)]
  for length, number in zip(x.shape[1:3], (rows, columns), strict=True):
    missing = (number + 1) * stride - length
    padding.append((missing // 2, missing - missing // 2))
  x = jnp.pad(x, (*padding, (0, 0)))
  # Squares of the size of the stride; a kernel covers two by two of them.
  x = x.reshape(-1, rows + 1, stride, columns + 1, stride, channels)
  x = x.swapaxes(2, 3).reshape(-1, rows + 1, columns + 1, stride**2 * channels)
  weights = kernel.reshape(2, stride, 2, stride, channels, outputs)
  weights = weights.swapaxes(1, 2).reshape(2, 2, -1, outputs)
  products = [
      x[:, i : i + rows, j : j + columns] @ weights[i, j]
      for i in range(2)
      for j in range(2)
  ]
  return products[0] + products[1] + products[2] + products[3]


@final
class Network(eqx.Module):
  """Network from features to numbers: convolutions for images, then an MLP."""

  convolutions: dict[str, Convolutions]
  layers: list[Linear]

  def __init__(
      self,
      encoder: features.Encoder,
      hidden: tuple[int, ...],
      size_out: int,
      scale_out: float,
      generator: np.random.Generator,
      num_more: int = 0,
  ) -> None:
    """Makes a network for the features of an encoder.

    Args:
      encoder: Encoder whose features are the input.
      hidden: Widths of the hidden layers.
      size_out: Number of outputs.
      scale_out: Scale of the last layer's initial weights.
      generator: Random generator of the initial weights.
      num_more: Number of elements of `vector` after those of the encoder.
    """
    size = encoder.vector_size + num_more
    self.convolutions = {}
    for name, shape in sorted(encoder.image_shapes.items()):
      self.convolutions[name] = Convolutions(shape[-1], generator)
      size += Convolutions.output_size(*shape[:2])
    sizes = (size, *hidden, size_out)
    scales = [math.sqrt(2)] * len(hidden) + [scale_out]
    self.layers = [
        Linear(sizes[i], sizes[i + 1], scale, generator)
        for i, scale in enumerate(scales)
    ]

  def __call__(self, encoded: dict[str, jax.Array]) -> jax.Array:
    images = [
        convolve(encoded[name]) for name, convolve in self.convolutions.items()
    ]
    x = jnp.concatenate([encoded['vector'], *images], axis=-1)
    for layer in self.layers[:-1]:
      x = jnp.tanh(layer(x))
    return self.layers[-1](x)


def draw(key: jax.Array, logits: jax.Array) -> jax.Array:
  """Draws indices from unnormalised log-probabilities.

  Args:
    key: Random key.
    logits: Log-probabilities, `(..., choices)`.

  Returns:
    Indices, `(...)`.
  """
  # Without an explicit mode, a global JAX setting selects it.
  return jax.random.categorical(key, logits, mode='low')


@final
class Categorical(eqx.Module):
  """Distribution over discrete actions, with logits `(..., actions)`."""

  logits: jax.Array

  def sample(self, key: jax.Array) -> jax.Array:
    """Draws one action for each distribution."""
    return draw(key, self.logits)

  def mode(self) -> jax.Array:
    """Returns the most likely action of each distribution."""
    return jnp.argmax(self.logits, axis=-1)

  def log_prob(self, action: jax.Array) -> jax.Array:
    """Returns the log-probability of the given actions, `(...)`."""
    log_probs = jax.nn.log_softmax(self.logits)
    # Use a sum over actions, because the gradient of a gather is slow.
    one_hot = jax.nn.one_hot(action, self.logits.shape[-1])
    return jnp.sum(log_probs * one_hot, axis=-1)

  def entropy(self) -> jax.Array:
    """Returns the entropy of each distribution, `(...)`."""
    log_probs = jax.nn.log_softmax(self.logits)
    return -jnp.sum(jnp.exp(log_probs) * log_probs, axis=-1)


@final
class Gaussian(eqx.Module):
  """Normal distribution over vectors, with independent elements.

  The mean has shape `(..., elements)`, and `log_std` has `(elements,)`.
  """

  mean: jax.Array
  log_std: jax.Array

  def sample(self, key: jax.Array) -> jax.Array:
    """Draws one action for each distribution."""
    noise = jax.random.normal(key, self.mean.shape)
    return self.mean + jnp.exp(self.log_std) * noise

  def mode(self) -> jax.Array:
    """Returns the most likely action of each distribution."""
    return self.mean

  def log_prob(self, action: jax.Array) -> jax.Array:
    """Returns the log-probability of the given actions, `(...)`."""
    z = (action - self.mean) * jnp.exp(-self.log_std)
    per_element = -0.5 * (z**2 + math.log(2 * math.pi)) - self.log_std
    return jnp.sum(per_element, axis=-1)

  def entropy(self) -> jax.Array:
    """Returns the entropy of each distribution, `(...)`."""
    per_element = self.log_std + 0.5 * math.log(2 * math.pi * math.e)
    entropy = jnp.sum(per_element)
    return jnp.broadcast_to(entropy, self.mean.shape[:-1])


@final
class Policy(eqx.Module):
  """Network from features to a distribution over actions."""

  network: Network
  log_std: jax.Array | None

  def __init__(
      self,
      encoder: features.Encoder,
      hidden: tuple[int, ...],
      size: int,
      is_discrete: bool,
      generator: np.random.Generator,
  ) -> None:
    """Makes a policy whose initial output hardly depends on observations.

    `size` is the number of discrete actions, or of the elements of a vector;
    the other arguments are those of `Network`.
    """
    self.network = Network(encoder, hidden, size, 0.01, generator)
    self.log_std = None if is_discrete else jnp.full(size, -0.5, jnp.float32)

  def __call__(self, encoded: dict[str, jax.Array]) -> Categorical | Gaussian:
    output = self.network(encoded)
    if self.log_std is None:
      return Categorical(output)
    return Gaussian(output, self.log_std)


@functools.partial(jax.jit, static_argnums=(0, 4))
def act(
    encoder: features.Encoder,
    policy: Callable[..., Any],
    observation: features.Packed,
    key: jax.Array,
    greedy: bool,
) -> tuple[jax.Array, jax.Array]:
  """Returns the actions of a policy, and the logarithms of their probabilities.

  Args:
    encoder: Encoder of observations.
    policy: Module from features to a distribution.
    observation: Packed observations.
    key: Random key.
    greedy: True to take the mode instead of drawing an action.

  Returns:
    Actions, `(worlds,)` or `(worlds, elements)`, and log-probabilities,
    `(worlds,)`.
  """
  distribution = policy(encoder.encode(observation))
  action = distribution.mode() if greedy else distribution.sample(key)
  return action, distribution.log_prob(action)


def _orthogonal(
    shape: tuple[int, ...], scale: float, generator: np.random.Generator
) -> jax.Array:
  """Returns weights with orthogonal rows or columns.

  NumPy computes them, because jax would spend seconds on compilation.
  """
  rows, columns = math.prod(shape[:-1]), shape[-1]
  normal = generator.normal(size=(max(rows, columns), min(rows, columns)))
  q, r = np.linalg.qr(normal)
  q = q * np.sign(np.diagonal(r))
  weights = q if rows >= columns else q.T
  return jnp.asarray(scale * weights.reshape(shape), jnp.float32)
