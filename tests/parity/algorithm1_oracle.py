"""Algorithm 1 of the paper, written once more from its equations, to hold the ``paper`` preset against.

Nothing of ``geodiff_plugin`` is imported: warp, SSIM, noise arithmetic and autograd are torch's own. Choices
that the paper leaves open are those of docs/explanation/method.md (E1 to E19), restated here.
"""

import torch
import torch.nn.functional as F

ETA, GAMMA, FLOOR = 0.85, 0.01, 0.001


def warp(right, depth, K, T):
    """Right image at the left pixels' places in it (Eq. 25), four corners by hand; and what lies inside."""
    height, width = depth.shape[-2:]
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    rays = torch.linalg.inv(K) @ torch.stack([u, v, torch.ones_like(u)]).float().flatten(1)
    p = K @ (T[:3, :3] @ (rays * depth.flatten()) + T[:3, 3:])
    u, v = (p[:2] / p[2]).view(2, height, width)
    slack = 1e-2  # rounding: the last pixel's centre itself is inside
    seen = (u >= -slack) & (u <= width - 1 + slack) & (v >= -slack) & (v <= height - 1 + slack)
    u, v = u.clamp(0, width - 1), v.clamp(0, height - 1)
    left, top = (
        u.detach().floor().clamp_max(width - 2).long(),
        v.detach().floor().clamp_max(height - 2).long(),
    )
    a, b = u - left, v - top
    upper = (1 - a) * right[:, top, left] + a * right[:, top, left + 1]
    lower = (1 - a) * right[:, top + 1, left] + a * right[:, top + 1, left + 1]
    return (1 - b) * upper + b * lower, seen


def ssim(x, y):
    """Gaussian window of 3 pixels, sigma 1.5, edges reflected."""
    w = torch.exp(-(torch.tensor([-1.0, 0.0, 1.0]) ** 2) / (2 * 1.5**2))
    kernel = torch.outer(w, w)[None, None] / w.sum() ** 2
    mean = lambda m: F.conv2d(F.pad(m[:, None], (1, 1, 1, 1), mode="reflect"), kernel)[:, 0]  # noqa: E731
    mx, my = mean(x), mean(y)
    vx, vy, vxy = mean(x * x) - mx**2, mean(y * y) - my**2, mean(x * y) - mx * my
    return (2 * mx * my + 1e-4) * (2 * vxy + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))


def photometric(left, right, depth, K, T):
    """Eq. 14 over what the right camera sees (E8)."""
    warped, seen = warp(right, depth, K, T)
    error = ETA * ((1 - ssim(left, warped)) / 2).clamp(0, 1) + (1 - ETA) * (left - warped).abs()
    return (error.mean(0) * seen).sum() / seen.sum().clamp_min(1), seen.any()


def algorithm_1(pipe, image_latent, text, z, steps, left, right, K, T, rate, rate_affine):
    """Scale, shift, g_s and z_{t-1} of every step; arguments are float32 tensors without a batch."""
    scheduler, found = pipe.scheduler, []
    s_hat, t_hat, g_s = torch.zeros(()), torch.zeros(()), None  # E5
    timesteps = [round(1000 - i * 1000 / steps) - 1 for i in range(steps)]
    for t in timesteps:
        alpha = scheduler.alphas_cumprod[t]
        before = scheduler.alphas_cumprod[max(t - 1000 // steps, 0)]
        z, s_hat, t_hat = (x.detach().requires_grad_() for x in (z, s_hat, t_hat))
        v = pipe.unet(torch.cat([image_latent, z])[None], t, encoder_hidden_states=text, return_dict=False)[
            0
        ][0]
        z0, eps = alpha.sqrt() * z - (1 - alpha).sqrt() * v, alpha.sqrt() * v + (1 - alpha).sqrt() * z  # E2
        x = (pipe.vae.decode(z0[None] / pipe.vae.config.scaling_factor).sample[0].mean(0) + 1) / 2
        x = ((x.double() + (x.double() ** 2 + 4 * FLOOR**2).sqrt()) / 2).float()  # E10, which cancels below 0
        relative = F.softplus(s_hat) * x + F.softplus(t_hat)  # Eq. 13
        if g_s is None:  # S7.3
            costs = [photometric(left, right, g * relative.detach(), K, T) for g in range(1, 81)]
            g_s = 1 + min(range(80), key=lambda k: costs[k][0].item() if costs[k][1] else float("inf"))
        loss = photometric(left, right, g_s * relative, K, T)[0] + GAMMA * (s_hat**2 + t_hat**2)  # Eq. 16, 17
        to_z, to_s, to_t = torch.autograd.grad(loss, (z, s_hat, t_hat))
        to_z = to_z * left[0].numel()  # E4: for latents Eq. 14 is a sum over pixels
        s_hat, t_hat = s_hat - rate_affine * to_s, t_hat - rate_affine * to_t
        z = before.sqrt() * z0 + (1 - before).sqrt() * eps - rate * to_z  # E12
        found.append((F.softplus(s_hat).item(), F.softplus(t_hat).item(), g_s, z.detach()))
    return found
