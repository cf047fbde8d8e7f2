"""Train the small prior: ``python -m examples.training.train --out DIR --hours 6``.

Data flow: rendered scenes -> autoencoder, then U-Net -> pipeline folder ``DIR/prior``; a killed run
    resumes.
Paper: none; a small version of Marigold's recipe (README.md next to the weights).
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path

import torch
from accelerate import Accelerator
from accelerate.utils import set_seed
from tqdm import tqdm

from examples.training.data import shards
from examples.training.latents import LatentStore
from examples.training.models import assemble, build_scheduler, build_text, build_unet
from examples.training.report import Reporter
from examples.training.schedule import (
    Stage,
    diffusion_loss,
    draw_timesteps,
    learning_rate,
    stage_at,
)
from examples.training.state import Average, Progress, restore, store
from examples.training.train_vae import save_vae, train_vae
from geodiff_plugin.bundled import open_pipeline

__all__ = ["main", "parse", "run"]

_AVERAGE_EVERY = 4


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    """Parse the command line; see ``--help``."""
    parser = argparse.ArgumentParser(prog="python -m examples.training.train", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of the run; pass it again to resume")
    parser.add_argument("--cache", type=Path, help="rendered scenes; default OUT/cache")
    parser.add_argument("--hours", type=float, default=6.0, help="wall-clock hours of the U-Net's training")
    parser.add_argument("--vae-minutes", type=float, default=8.0)
    parser.add_argument("--vae-batch", type=int, default=4, help="crops per process and autoencoder step")
    parser.add_argument(
        "--device", default="cpu", help="cpu or cuda; several devices through accelerate launch"
    )
    parser.add_argument(
        "--init-from", type=Path, help="prior folder to continue from; its autoencoder is kept"
    )
    parser.add_argument("--batch", type=int, default=16, help="scenes per process and step at low resolution")
    parser.add_argument("--rate", type=float, default=1e-3, help="top learning rate")
    parser.add_argument("--average", type=float, default=0.999, help="decay of the moving average")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=0, help="threads of this process; 0: torch's default")
    parser.add_argument("--renderers", type=int, default=1, help="background processes that fill the cache")
    parser.add_argument("--scenes", type=int, default=20_000, help="maximum number of scenes in the cache")
    parser.add_argument(
        "--first-scenes", type=int, default=256, help="number of scenes to wait for before the start"
    )
    parser.add_argument(
        "--fresh", action="store_true", help="render every batch on the device without storing it (GPU)"
    )
    parser.add_argument("--validate-minutes", type=float, default=8.0)
    parser.add_argument("--validation-scenes", type=int, default=48)
    parser.add_argument("--steps", type=int, help="a fixed number of U-Net steps instead of --hours")
    parser.add_argument("--vae-steps", type=int, help="a fixed number of autoencoder steps")
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> None:
    """Command line of the training."""
    run(parse(argv))


def run(options: argparse.Namespace) -> Progress:
    """Train or continue, and write ``OUT/prior``.

    Args:
        options: from ``parse``.

    Returns:
        Counters at the end.
    """
    if options.threads:
        torch.set_num_threads(options.threads)
    accelerator = Accelerator(mixed_precision="bf16", cpu=options.device == "cpu")
    options.cache = options.cache or options.out / "cache"
    options.out.mkdir(parents=True, exist_ok=True)
    workers = _start_renderers(options) if accelerator.is_main_process else []
    try:
        return _train(options, accelerator)
    finally:
        for worker in workers:
            worker.terminate()
            worker.wait()


def _start_renderers(options: argparse.Namespace) -> list[subprocess.Popen]:
    """Start background processes that fill the cache; they stop when this process ends."""
    command = [
        sys.executable,
        "-m",
        "examples.training.data",
        "--cache",
        str(options.cache),
    ]
    command += ["--stop", str(-(-options.scenes // 16)), "--step", str(options.renderers)]
    command += ["--parent", str(os.getpid())]
    return [subprocess.Popen([*command, "--first", str(k)]) for k in range(options.renderers)]


def _prepare_models(options: argparse.Namespace, accelerator: Accelerator):
    """Autoencoder (trained first), U-Net, text encoder and tokenizer."""
    set_seed(options.seed)
    if options.init_from:
        start = open_pipeline(options.init_from)
        vae = start.vae
        unet = start.unet.train()
        text = (start.text_encoder, start.tokenizer)
        vae.requires_grad_(False)
        if accelerator.is_main_process:
            save_vae(vae, options.out / "vae.safetensors")
        return vae.to(accelerator.device), unet, text
    seconds = 60 * options.vae_minutes
    batch = options.vae_batch
    vae = train_vae(
        options.out, options.cache, accelerator, seconds, options.seed, batch, iterations=options.vae_steps
    )
    set_seed(options.seed)
    return vae, build_unet(), build_text()


def _wait_for_scenes(options: argparse.Namespace) -> None:
    while 16 * len(shards(options.cache)) < min(options.first_scenes, options.scenes):
        time.sleep(0.5)


def _train(options: argparse.Namespace, accelerator: Accelerator) -> Progress:
    """Both stages; returns the counters at the end."""
    _wait_for_scenes(options)
    vae, unet, text = _prepare_models(options, accelerator)
    device = accelerator.device
    average = Average(unet.to(device), options.average**_AVERAGE_EVERY)
    settings = {"lr": options.rate, "betas": (0.9, 0.99), "weight_decay": 1e-3, "fused": True}
    optimiser = torch.optim.AdamW(unet.parameters(), **settings)
    progress = restore(options.out, unet, average, optimiser) or Progress(seed=options.seed)
    network, prepared = accelerator.prepare(unet, optimiser)
    reporter = Reporter(options, assemble(vae, build_unet().to(device).eval(), text))
    step_of = _Step(network, _embed(text).to(device), options, accelerator, progress.step)
    started = time.monotonic()
    base = progress.seconds
    pools = {}
    bar = tqdm(total=1000, unit="permille", mininterval=10, disable=not accelerator.is_main_process)
    while True:
        progress.seconds = base + time.monotonic() - started
        spent = progress.step / options.steps if options.steps else progress.seconds / (3600 * options.hours)
        fraction = float(accelerator.reduce(torch.tensor(spent, device=device), "mean"))
        stage = stage_at(fraction, continued=options.init_from is not None)
        if accelerator.is_main_process and (fraction >= 1 or reporter.due(progress)):
            store(options.out, unet, average, optimiser, progress)
            reporter.report(progress, average, min(stage.divisors), last=fraction >= 1)
        if fraction >= 1:
            break
        divisor = stage.divisors[progress.step % len(stage.divisors)]
        if divisor not in pools:
            pools[divisor] = _open_pool(divisor, options, vae, accelerator)
        pool = pools[divisor]
        if progress.step % 50 < len(stage.divisors) or not len(pool):
            pool.refresh(8)
        for group in optimiser.param_groups:
            group["lr"] = learning_rate(options.rate, fraction, progress.step)
        loss, size = step_of(pool, stage, prepared)
        if progress.step % _AVERAGE_EVERY == 0:
            average.update(unet, progress.step // _AVERAGE_EVERY)
        progress.step += 1
        progress.samples += size * accelerator.num_processes
        reporter.loss(loss)
        if progress.step % 20 == 0:
            bar.update(int(1000 * fraction) - bar.n)
            bar.set_postfix(step=progress.step, loss=f"{reporter.mean_loss:.4f}", scenes=len(pool))
    bar.close()
    accelerator.wait_for_everyone()
    return progress


class _Step:
    """One optimiser step: draws a batch, noise and timesteps, and descends the gradient.

    Args:
        network: the denoiser as prepared by accelerate.
        text: empty-prompt embedding ``(1, L, C)``.
        options: from ``parse``.
        accelerator: device and processes.
        step: current step of the run, so that a resumed run draws new samples.
    """

    def __init__(
        self,
        network: torch.nn.Module,
        text: torch.Tensor,
        options: argparse.Namespace,
        accelerator: Accelerator,
        step: int,
    ) -> None:
        self.network = network
        self.text = text
        self.batch = options.batch
        self.accelerator = accelerator
        self.generator = torch.Generator().manual_seed(options.seed + 7919 * step + accelerator.process_index)
        self.scheduler = build_scheduler()
        self.scheduler.alphas_cumprod = self.scheduler.alphas_cumprod.to(accelerator.device)

    def __call__(self, pool: LatentStore, stage: Stage, optimiser) -> tuple[torch.Tensor, int]:
        """Return the loss and the number of scenes; half as many at full size as at low resolution."""
        size = max(self.batch * pool.divisor // 2, 1)
        image, depth = (x.to(self.text.device) for x in pool.batch(size, self.generator))
        noise = torch.randn(depth.shape, generator=self.generator).to(depth.device)
        timesteps = draw_timesteps(size, stage.last, self.generator).to(depth.device)
        loss = diffusion_loss(self.network, self.scheduler, image, depth, self.text, timesteps, noise)
        self.accelerator.backward(loss)
        self.accelerator.clip_grad_norm_(self.network.parameters(), 1.0)
        optimiser.step()
        optimiser.zero_grad(set_to_none=True)
        return loss, size


def _open_pool(divisor: int, options, vae, accelerator: Accelerator) -> LatentStore:
    """Open the store of one resolution; low resolutions also store mirrored scenes."""
    rank, world = accelerator.process_index, accelerator.num_processes
    variants = 2 if divisor == 2 else 1
    return LatentStore(options.cache, vae, divisor, variants, rank, world, fresh=options.fresh)


@torch.no_grad()
def _embed(text) -> torch.Tensor:
    encoder, tokenizer = text
    ids = tokenizer("", padding="do_not_pad", max_length=77, truncation=True, return_tensors="pt").input_ids
    return encoder.float()(ids)[0]


if __name__ == "__main__":
    main()
