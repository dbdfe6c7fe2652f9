"""Compiled statics of a braced arm at many instants with exact derivatives, and the local solver.

The arm has a fixed base and joints with one coordinate each. Brace forces and joint torques are

    F_c = f_c (n − μ v_t / √(|v_t|² + v_s²)),    τ = g(q) + (D + D_m) v − Σ_c J_cᵀ F_c

for braces c with the surface normal n at the brace and the velocity v_t of the contact point along the surface.
Each knot k has a posture q_k. Instants e are between knots, with postures q_e = Σ_k blend_ek q_k and velocities
v_e = Σ_k chord_ek q_k. On a path that goes back and forth, there are two instants for each posture.

The key of the machine code of a function includes all files of this folder, see :mod:`dynsim.jit.kernel`.
"""
