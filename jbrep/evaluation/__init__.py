"""Diagnostics: what encoders lose, what their latents look like, what can be read from them."""
