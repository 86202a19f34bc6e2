"""Network and losses in float64 numpy, written from the papers' equations: no arithmetic shared with the learner.

Slow and plain: loops over samples, over atoms, and over the positions of a convolution. Imports numpy and the
configuration.
"""

from typing import Any

import numpy as np

from learner.config import EpsilonConfig


def softmax(x):
    e = np.exp(x - x.max(-1, keepdims=True))
    return e / e.sum(-1, keepdims=True)


def convolve(x, kernel, bias, stride):
    """Valid convolution of [B, H, W, C] with [k, k, C, F]: one product for every position."""
    x, kernel = np.asarray(x, np.float64), np.asarray(kernel, np.float64)
    k = kernel.shape[0]
    rows, columns = ((size - k) // stride + 1 for size in x.shape[1:3])
    out = np.zeros((len(x), rows, columns, kernel.shape[-1]))
    for i in range(rows):
        for j in range(columns):
            window = x[:, i * stride : i * stride + k, j * stride : j * stride + k]
            out[:, i, j] = np.tensordot(window, kernel, 3) + bias
    return out


def network(config: EpsilonConfig, params: Any, obs, num_actions: int, num_tasks: int):
    """Logits [B, A, N] by the means of the weights: thesis 4.1.5, eq. 4.10 and 4.18."""
    p = {layer: {name: np.asarray(w, np.float64) for name, w in leaves.items()} for layer, leaves in params.items()}
    x = np.asarray(obs.frames, np.float64) / 255
    for i, stride in enumerate(config.conv_strides):
        x = np.maximum(convolve(x, p[f"conv_{i}"]["kernel"], p[f"conv_{i}"]["bias"], stride), 0)
    x = x.reshape(len(x), -1)
    one_hot = np.vstack([np.eye(num_actions), np.zeros(num_actions)])  # of -1: the last row
    past = [one_hot[np.asarray(obs.actions)[:, k]] for k in range(obs.actions.shape[1])]
    x = np.concatenate([x, np.asarray(obs.vector, np.float64) / 100, *past], axis=1)
    if config.task_conditioned:
        x = np.concatenate([x, np.eye(num_tasks)[np.asarray(obs.task)]], axis=1)

    def stream(name: str):
        hidden, output = p[f"{name}_hidden"], p[f"{name}_output"]
        h = x @ hidden["kernel"].T + hidden["bias"]
        if norm := p.get(f"{name}_norm"):
            h = (h - h.mean(1, keepdims=True)) / np.sqrt(h.var(1, keepdims=True) + 1e-6)
            h = h * norm["scale"] + norm["bias"]
        return np.maximum(h, 0) @ output["kernel"].T + output["bias"]

    if not getattr(config, "dueling", False):
        return stream("q").reshape(len(x), num_actions, -1)
    advantage = stream("advantage").reshape(len(x), num_actions, -1)
    return stream("value")[:, None] + advantage - advantage.mean(1, keepdims=True)


def huber(error):
    return np.where(np.abs(error) < 1, error**2 / 2, np.abs(error) - 0.5)


def td(q_tm1, a_tm1, r_t, discount_t, q_t_value, q_t_selector=None):
    found = []
    for i in range(len(a_tm1)):
        selector = q_t_value[i] if q_t_selector is None else q_t_selector[i]
        best = max(range(len(selector)), key=lambda a: selector[a])
        found.append(r_t[i] + discount_t[i] * q_t_value[i][best] - q_tm1[i][a_tm1[i]])
    return np.array(found, np.float64)


def project(shifted_atoms, probabilities, atoms):
    """Bellemare et al. 2017, Algorithm 1: b = (Tz - v_min) / dz, mass to floor(b) and ceil(b)."""
    v_min, v_max, n = float(atoms[0]), float(atoms[-1]), len(atoms)
    width = (v_max - v_min) / (n - 1)
    projected = np.zeros(n, np.float64)
    for z, p in zip(np.asarray(shifted_atoms, np.float64), np.asarray(probabilities, np.float64), strict=True):
        b = (min(max(z, v_min), v_max) - v_min) / width
        low = min(int(np.floor(b)), n - 1)
        high = min(low + 1, n - 1)
        projected[low] += p * (1 - (b - low))
        projected[high] += p * (b - low)
    return projected


def categorical(logits_tm1, a_tm1, r_t, discount_t, logits_t, atoms, q_t_selector=None):
    """(cross-entropy, KL divergence) in float64."""
    results = []
    for i in range(len(a_tm1)):
        p_t = [softmax(row) for row in np.asarray(logits_t[i], np.float64)]
        q = [float(p @ atoms) for p in p_t] if q_t_selector is None else list(q_t_selector[i])
        target = project(r_t[i] + discount_t[i] * np.asarray(atoms, np.float64), p_t[int(np.argmax(q))], atoms)
        log_p = np.log(softmax(np.asarray(logits_tm1[i][a_tm1[i]], np.float64)))
        entropy = -sum(t * np.log(t) for t in target if t > 0)
        cross_entropy = -float(target @ log_p)
        results.append((cross_entropy, cross_entropy - entropy))
    return np.array(results).T
