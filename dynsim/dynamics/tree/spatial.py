"""Spatial algebra on tuples of numbers or SIMD vectors: 3-vectors, rotations, six-vectors, articulated inertias.

Motions are (angular, linear) and wrenches (moment, force), both about the world origin in the axes of W (Featherstone,
Rigid Body Dynamics Algorithms, 2008). A rotation is nine numbers, row by row. Tuples live in registers; ``six`` and
similar functions read them from row i of a table, starting at column c, and ``put_six`` etc. write them there.
"""

from __future__ import annotations

from dynsim.jit.kernel import internal_kernel

ZERO_VECTOR = (0.0, 0.0, 0.0)
ZERO_SIX = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
ZERO_INERTIA = (0.0,) * 21


@internal_kernel
def vector(table, i, c):
    """Return the 3-vector in row i, starting at column c."""
    return table[i, c], table[i, c + 1], table[i, c + 2]


@internal_kernel
def put_vector(table, i, c, a):
    """Write a 3-vector to row i, starting at column c."""
    table[i, c], table[i, c + 1], table[i, c + 2] = a[0], a[1], a[2]


@internal_kernel
def rotation(table, i, c):
    """Return the rotation in row i, starting at column c."""
    return (
        table[i, c], table[i, c + 1], table[i, c + 2],
        table[i, c + 3], table[i, c + 4], table[i, c + 5],
        table[i, c + 6], table[i, c + 7], table[i, c + 8],
    )  # fmt: skip


@internal_kernel
def put_rotation(table, i, c, R):
    """Write a rotation to row i, starting at column c."""
    table[i, c], table[i, c + 1], table[i, c + 2] = R[0], R[1], R[2]
    table[i, c + 3], table[i, c + 4], table[i, c + 5] = R[3], R[4], R[5]
    table[i, c + 6], table[i, c + 7], table[i, c + 8] = R[6], R[7], R[8]


@internal_kernel
def six(table, i, c):
    """Return the six-vector in row i, starting at column c."""
    return table[i, c], table[i, c + 1], table[i, c + 2], table[i, c + 3], table[i, c + 4], table[i, c + 5]


@internal_kernel
def put_six(table, i, c, a):
    """Write a six-vector to row i, starting at column c."""
    table[i, c], table[i, c + 1], table[i, c + 2] = a[0], a[1], a[2]
    table[i, c + 3], table[i, c + 4], table[i, c + 5] = a[3], a[4], a[5]


@internal_kernel
def cross(a, b):
    """Return a × b for 3-vectors."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@internal_kernel
def dot_vector(a, b):
    """Return a · b for 3-vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@internal_kernel
def times_number(a, x):
    """Return a x for a 3-vector a and a number x."""
    return a[0] * x, a[1] * x, a[2] * x


@internal_kernel
def along(a, b, x):
    """Return a + b x for 3-vectors a, b and a number x."""
    return a[0] + b[0] * x, a[1] + b[1] * x, a[2] + b[2] * x


@internal_kernel
def first_axis(R):
    """Return R e_x, the first column of a rotation."""
    return R[0], R[3], R[6]


@internal_kernel
def second_axis(R):
    """Return R e_y, the second column of a rotation."""
    return R[1], R[4], R[7]


@internal_kernel
def third_axis(R):
    """Return R e_z, the third column of a rotation."""
    return R[2], R[5], R[8]


@internal_kernel
def rotate(R, u):
    """Return R u, the vector u rotated by R."""
    return (
        R[0] * u[0] + R[1] * u[1] + R[2] * u[2],
        R[3] * u[0] + R[4] * u[1] + R[5] * u[2],
        R[6] * u[0] + R[7] * u[1] + R[8] * u[2],
    )


@internal_kernel
def rotate_back(R, u):
    """Return Rᵀ u, the vector u rotated by the inverse of R."""
    return (
        R[0] * u[0] + R[3] * u[1] + R[6] * u[2],
        R[1] * u[0] + R[4] * u[1] + R[7] * u[2],
        R[2] * u[0] + R[5] * u[1] + R[8] * u[2],
    )


@internal_kernel
def transform(p, R, u):
    """Return p + R u, the point u of a frame with origin p and rotation R."""
    return (
        p[0] + R[0] * u[0] + R[1] * u[1] + R[2] * u[2],
        p[1] + R[3] * u[0] + R[4] * u[1] + R[5] * u[2],
        p[2] + R[6] * u[0] + R[7] * u[1] + R[8] * u[2],
    )


@internal_kernel
def times_inertia(I, u):
    """Return I u for a symmetric matrix I (xx xy xz yy yz zz)."""
    return (
        I[0] * u[0] + I[1] * u[1] + I[2] * u[2],
        I[1] * u[0] + I[3] * u[1] + I[4] * u[2],
        I[2] * u[0] + I[4] * u[1] + I[5] * u[2],
    )


@internal_kernel
def point_velocity(V, c):
    """Return v + ω × c, the velocity of the point c of a body with motion V = (ω, v)."""
    return (
        V[3] + V[1] * c[2] - V[2] * c[1],
        V[4] + V[2] * c[0] - V[0] * c[2],
        V[5] + V[0] * c[1] - V[1] * c[0],
    )


@internal_kernel
def compose(A, B):
    """Return A B, the product of two rotations."""
    return (
        A[0] * B[0] + A[1] * B[3] + A[2] * B[6],
        A[0] * B[1] + A[1] * B[4] + A[2] * B[7],
        A[0] * B[2] + A[1] * B[5] + A[2] * B[8],
        A[3] * B[0] + A[4] * B[3] + A[5] * B[6],
        A[3] * B[1] + A[4] * B[4] + A[5] * B[7],
        A[3] * B[2] + A[4] * B[5] + A[5] * B[8],
        A[6] * B[0] + A[7] * B[3] + A[8] * B[6],
        A[6] * B[1] + A[7] * B[4] + A[8] * B[7],
        A[6] * B[2] + A[7] * B[5] + A[8] * B[8],
    )


@internal_kernel
def rotated_symmetric(R, I):
    """Return R I Rᵀ for a symmetric matrix I (xx xy xz yy yz zz)."""
    x, y, z = rotate(R, (I[0], I[1], I[2])), rotate(R, (I[1], I[3], I[4])), rotate(R, (I[2], I[4], I[5]))
    a, b, c = rotate(R, (x[0], y[0], z[0])), rotate(R, (x[1], y[1], z[1])), rotate(R, (x[2], y[2], z[2]))
    return a[0], a[1], a[2], b[1], b[2], c[2]


@internal_kernel
def turn(B, u, z, s, c):
    """Return B R(u, angle) by Rodrigues' formula, c B + s B [u]× + (1 − c) z uᵀ, with z = B u, sine s and cosine c."""
    d = 1.0 - c
    return (
        c * B[0] + s * (B[1] * u[2] - B[2] * u[1]) + d * z[0] * u[0],
        c * B[1] + s * (B[2] * u[0] - B[0] * u[2]) + d * z[0] * u[1],
        c * B[2] + s * (B[0] * u[1] - B[1] * u[0]) + d * z[0] * u[2],
        c * B[3] + s * (B[4] * u[2] - B[5] * u[1]) + d * z[1] * u[0],
        c * B[4] + s * (B[5] * u[0] - B[3] * u[2]) + d * z[1] * u[1],
        c * B[5] + s * (B[3] * u[1] - B[4] * u[0]) + d * z[1] * u[2],
        c * B[6] + s * (B[7] * u[2] - B[8] * u[1]) + d * z[2] * u[0],
        c * B[7] + s * (B[8] * u[0] - B[6] * u[2]) + d * z[2] * u[1],
        c * B[8] + s * (B[6] * u[1] - B[7] * u[0]) + d * z[2] * u[2],
    )


@internal_kernel
def turn_x(B, s, c):
    """Return B R(x, angle), given the sine s and cosine c of the angle."""
    return (
        B[0], c * B[1] + s * B[2], c * B[2] - s * B[1],
        B[3], c * B[4] + s * B[5], c * B[5] - s * B[4],
        B[6], c * B[7] + s * B[8], c * B[8] - s * B[7],
    )  # fmt: skip


@internal_kernel
def turn_y(B, s, c):
    """Return B R(y, angle), given the sine s and cosine c of the angle."""
    return (
        c * B[0] - s * B[2], B[1], c * B[2] + s * B[0],
        c * B[3] - s * B[5], B[4], c * B[5] + s * B[3],
        c * B[6] - s * B[8], B[7], c * B[8] + s * B[6],
    )  # fmt: skip


@internal_kernel
def turn_z(B, s, c):
    """Return B R(z, angle), given the sine s and cosine c of the angle."""
    return (
        c * B[0] + s * B[1], c * B[1] - s * B[0], B[2],
        c * B[3] + s * B[4], c * B[4] - s * B[3], B[5],
        c * B[6] + s * B[7], c * B[7] - s * B[6], B[8],
    )  # fmt: skip


@internal_kernel
def cross_motion(V, S):
    """Return V × S of motions, the rate of change of S in the world frame if S moves with V."""
    return (
        V[1] * S[2] - V[2] * S[1],
        V[2] * S[0] - V[0] * S[2],
        V[0] * S[1] - V[1] * S[0],
        V[1] * S[5] - V[2] * S[4] + V[4] * S[2] - V[5] * S[1],
        V[2] * S[3] - V[0] * S[5] + V[5] * S[0] - V[3] * S[2],
        V[0] * S[4] - V[1] * S[3] + V[3] * S[1] - V[4] * S[0],
    )


@internal_kernel
def point_acceleration(A, V, c):
    """Return a + ε × c + ω × (v + ω × c), the acceleration of point c of a body with V = (ω, v) and A = (ε, a)."""
    v = point_velocity(V, c)
    return (
        A[3] + A[1] * c[2] - A[2] * c[1] + V[1] * v[2] - V[2] * v[1],
        A[4] + A[2] * c[0] - A[0] * c[2] + V[2] * v[0] - V[0] * v[2],
        A[5] + A[0] * c[1] - A[1] * c[0] + V[0] * v[1] - V[1] * v[0],
    )


@internal_kernel
def wrench_at(r, force, moment):
    """Return the wrench about the world origin of a force at r and a moment."""
    return (
        moment[0] + r[1] * force[2] - r[2] * force[1],
        moment[1] + r[2] * force[0] - r[0] * force[2],
        moment[2] + r[0] * force[1] - r[1] * force[0],
        force[0],
        force[1],
        force[2],
    )


@internal_kernel
def dot(a, b):
    """Return a · b for six-vectors: the power of a wrench on a motion.

    The terms are summed in pairs, which shortens the chain of dependent additions.
    """
    return ((a[0] * b[0] + a[1] * b[1]) + (a[2] * b[2] + a[3] * b[3])) + (a[4] * b[4] + a[5] * b[5])


@internal_kernel
def dot_plus(a, b, x):
    """Return a · b + x, summed in the same order as in :func:`dot`."""
    return ((a[0] * b[0] + a[1] * b[1]) + (a[2] * b[2] + a[3] * b[3])) + ((a[4] * b[4] + a[5] * b[5]) + x)


@internal_kernel
def plus(a, b):
    """Return a + b for six-vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3], a[4] + b[4], a[5] + b[5]


@internal_kernel
def negative(a):
    """Return −a for a six-vector."""
    return -a[0], -a[1], -a[2], -a[3], -a[4], -a[5]


@internal_kernel
def scaled(a, x):
    """Return a x for a six-vector a and a number x."""
    return a[0] * x, a[1] * x, a[2] * x, a[3] * x, a[4] * x, a[5] * x


@internal_kernel
def plus_scaled(a, b, x):
    """Return a + b x for six-vectors a, b and a number x."""
    return (
        a[0] + b[0] * x, a[1] + b[1] * x, a[2] + b[2] * x, a[3] + b[3] * x, a[4] + b[4] * x, a[5] + b[5] * x
    )  # fmt: skip


@internal_kernel
def minus_scaled(a, b, x):
    """Return a − b x for six-vectors a, b and a number x."""
    return (
        a[0] - b[0] * x, a[1] - b[1] * x, a[2] - b[2] * x, a[3] - b[3] * x, a[4] - b[4] * x, a[5] - b[5] * x
    )  # fmt: skip


@internal_kernel
def body_in_world(m, c, I):
    """Return the spatial inertia about the world origin, as 21 numbers, of a mass m at c with I_c about c.

    I_c is (xx xy xz yy yz zz). The blocks are [[A, H], [Hᵀ, M]]: A and M are symmetric, with six numbers each; H is
    stored row by row. A = I_c + m (c² 1 − c cᵀ), H = m [c]×.
    """
    x, y, z = m * c[0], m * c[1], m * c[2]
    return (
        I[0] + y * c[1] + z * c[2], I[1] - x * c[1], I[2] - x * c[2],
        I[3] + x * c[0] + z * c[2], I[4] - y * c[2], I[5] + x * c[0] + y * c[1],
        0.0, -z, y, z, 0.0, -x, -y, x, 0.0,
        m, 0.0, 0.0, m, 0.0, m,
    )  # fmt: skip


@internal_kernel
def inertia(table, i, c):
    """Return the articulated inertia in row i, starting at column c."""
    return (
        table[i, c], table[i, c + 1], table[i, c + 2], table[i, c + 3], table[i, c + 4], table[i, c + 5],
        table[i, c + 6], table[i, c + 7], table[i, c + 8], table[i, c + 9], table[i, c + 10], table[i, c + 11],
        table[i, c + 12], table[i, c + 13], table[i, c + 14], table[i, c + 15], table[i, c + 16], table[i, c + 17],
        table[i, c + 18], table[i, c + 19], table[i, c + 20],
    )  # fmt: skip


@internal_kernel
def plus_inertia(a, b):
    """Return a + b for articulated inertias."""
    return (
        a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3], a[4] + b[4], a[5] + b[5], a[6] + b[6],
        a[7] + b[7], a[8] + b[8], a[9] + b[9], a[10] + b[10], a[11] + b[11], a[12] + b[12], a[13] + b[13],
        a[14] + b[14], a[15] + b[15], a[16] + b[16], a[17] + b[17], a[18] + b[18], a[19] + b[19], a[20] + b[20],
    )  # fmt: skip


@internal_kernel
def times(a, s):
    """Return the wrench a s of an articulated inertia a and a motion s."""
    return (
        ((a[0] * s[0] + a[1] * s[1]) + (a[2] * s[2] + a[6] * s[3])) + (a[7] * s[4] + a[8] * s[5]),
        ((a[1] * s[0] + a[3] * s[1]) + (a[4] * s[2] + a[9] * s[3])) + (a[10] * s[4] + a[11] * s[5]),
        ((a[2] * s[0] + a[4] * s[1]) + (a[5] * s[2] + a[12] * s[3])) + (a[13] * s[4] + a[14] * s[5]),
        ((a[6] * s[0] + a[9] * s[1]) + (a[12] * s[2] + a[15] * s[3])) + (a[16] * s[4] + a[17] * s[5]),
        ((a[7] * s[0] + a[10] * s[1]) + (a[13] * s[2] + a[16] * s[3])) + (a[18] * s[4] + a[19] * s[5]),
        ((a[8] * s[0] + a[11] * s[1]) + (a[14] * s[2] + a[17] * s[3])) + (a[19] * s[4] + a[20] * s[5]),
    )


@internal_kernel
def minus_outer(a, d, u):
    """Return the symmetric a − d uᵀ with d = u / D, the articulated inertia that a joint passes down."""
    return (
        a[0] - d[0] * u[0], a[1] - d[0] * u[1], a[2] - d[0] * u[2],
        a[3] - d[1] * u[1], a[4] - d[1] * u[2], a[5] - d[2] * u[2],
        a[6] - d[0] * u[3], a[7] - d[0] * u[4], a[8] - d[0] * u[5],
        a[9] - d[1] * u[3], a[10] - d[1] * u[4], a[11] - d[1] * u[5],
        a[12] - d[2] * u[3], a[13] - d[2] * u[4], a[14] - d[2] * u[5],
        a[15] - d[3] * u[3], a[16] - d[3] * u[4], a[17] - d[3] * u[5],
        a[18] - d[4] * u[4], a[19] - d[4] * u[5], a[20] - d[5] * u[5],
    )  # fmt: skip
