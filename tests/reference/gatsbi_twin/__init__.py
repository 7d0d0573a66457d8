"""GATSBI in PyTorch: the twin of the Rust model.

Start with `model`, whose `observe`, `imagine` and `skip` are the three kinds of step, then read `mixture`
(agent and background) and `objects`. `checkpoint` loads the files of the Rust trainer.

Shape letters: `B` batch, `K` mixture slots, `N` objects or cells, `H`, `W` image, `Z` width of an object's
latent vector.
"""
