"""One compiled chunk, to be timed without the driver around it."""


def compiled(system, state, samples, frames=0, members=None):
    """A function of system and state that runs so many samples; members: how many side by side,
    None: one alone.
    """
    import jax
    import jax.numpy as jnp

    from dem_jax import xla_flags
    from dem_jax.dynamics import stepping

    count, every, phase = jnp.int32(samples), jnp.int32(1), jnp.int32(0)
    run = lambda system, state: stepping.run_chunk(
        system, state, count, every, samples, frames, phase
    )
    run = run if members is None else jax.vmap(run, in_axes=(None, 0))
    return xla_flags.jit_for_backend(run, jax.default_backend()).lower(system, state).compile()
