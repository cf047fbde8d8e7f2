"""Training of the bundled prior: rendered scenes, autoencoder, denoiser, validation.

Data flow: seeds of scenes -> a ``MarigoldDepthPipeline`` folder.
Paper: S3.1 (a latent diffusion prior); this one is ours.
"""
