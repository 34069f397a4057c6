"""Two JAX operations that return their argument unchanged, to the last bit, and make XLA compute it
only once.

XLA fuses a cheap producer into every consumer, and on the CPU an optimisation barrier does not
prevent this; a producer that ends in a division counts as too expensive to repeat. This matters
most in reverse mode: the derivative by each component of a vector begins with the derivatives of
all dependent values, and a step of one box was written out two to three times.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

Array = jax.Array


def _divide_by_one(x: Array) -> Array:
    """x / 1, with a divisor of which only the machine-code compiler detects that it is 1, and which
    therefore removes the division.
    """
    if jnp.issubdtype(x.dtype, jnp.integer):
        return jax.lax.div(x, jnp.maximum(jnp.minimum(x, 1), 1))
    bits = jax.lax.bitcast_convert_type(x, {4: jnp.int32, 8: jnp.int64}[x.dtype.itemsize])
    return x / jnp.maximum(jnp.minimum(bits, 1), 1).astype(x.dtype)


def _make_identity(name: str, program: Callable[[Array], Array]) -> Primitive:
    """An identity operation, still without derivatives. program: its lowering to XLA."""
    identity = Primitive(name)
    identity.def_impl(lambda x: x)
    identity.def_abstract_eval(lambda x: x)
    batching.defvectorized(identity)
    mlir.register_lowering(identity, mlir.lower_fun(program, multiple_results=False))
    return identity


# FUSION_BARRIER: the value is computed once although several kernels use it, and so are its
# derivatives. DERIVATIVE_BARRIER: only the derivatives; without differentiation it has no effect.
FUSION_BARRIER = _make_identity("kept", _divide_by_one)
DERIVATIVE_BARRIER = _make_identity("kept_in_derivatives", lambda x: x)

ad.deflinear2(FUSION_BARRIER, lambda of, _: [FUSION_BARRIER.bind(of)])
ad.defjvp(DERIVATIVE_BARRIER, lambda tangent, _: FUSION_BARRIER.bind(tangent))
