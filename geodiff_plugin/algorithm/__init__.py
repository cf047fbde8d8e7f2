"""One guided denoising step, from the estimate to the moved latent: Algorithm 1 and corrections."""
