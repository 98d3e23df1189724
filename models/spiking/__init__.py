"""A spiking network trained on events, with Loihi 1's integer arithmetic in its forward pass.

In each step a neuron computes, in the chip's integers (Davies et al. 2018, Section "Neuron model";
rounding as in NengoLoihi's emulator, ``emulator/interface.py`` and ``builder/discretize.py``):

=======================  ========================================================================
synaptic input           q(t) = 128 sum over i of w_i s_i(t),  w_i an integer, -127 to 127
current                  u(t) = trunc(keep_u u(t-1) / 4096) + q(t)
voltage                  v(t) = max(trunc(keep_v v(t-1) / 4096) + u(t) + bias, floor)
spike                    s(t) = 1 if v(t) > theta, and then v(t) is reset to 0
=======================  ========================================================================

keep_u and keep_v are integers from 2 to 4095, in 4096ths; theta is a multiple of 64; floor, the
lower voltage bound, is -(2^k) + 1; the bias is 12 bits times a power of two.  Without a refractory
period (NengoLoihi's ``tau_ref`` of 0) the neuron integrates again in the step after its spike.  On
the chip a spike arrives one step after it was sent; here it arrives in the same step, which only
shifts the spikes of layer n by n steps.

The trained parameters are real numbers: weights W and biases b in units of the threshold, and for
each layer one time constant of the current and one of the voltage.  They determine the integers:

    w = round(127 W / max abs W),   theta = 64 round(2 * 127 / max abs W),   bias = round(theta b)

so that the largest weight is 127, as NengoLoihi requires, and W is w 128 / theta.  (In a layer that
is divided among cores by its outputs, NengoLoihi does this for each core's block, so that the
chip's integers differ slightly: :func:`deploy.network.blocks.find_rescaled_layers`.)  The gradient
of rounding is straight-through.  A neuron's bias is limited so that it cannot fire without input.

The gradients through time are below, with a = keep_u / 4096, b = keep_v / 4096, the loss E, and the
surrogate theta' = 1 / (theta (1 + beta abs(v / theta - 1))^2) for the derivative of a spike (the
fast sigmoid of Zenke and Ganguli 2018); the reset is not differentiated (Zenke and Vogels 2021):

    dE/dv(t) = dE/ds(t) theta' + b (1 - s(t)) dE/dv(t+1),      0 where v(t) is at its lower bound
    dE/du(t) = dE/dv(t) + a dE/du(t+1),                        dE/dq(t) = dE/du(t)
    dE/da = sum over t of dE/du(t) u(t-1),                     dE/db likewise with v

The output accumulates its weights K over the spikes of the last layer, from the sample's start:

    y(t) = sum over t' <= t of K(t') s(t').

K may differ between consecutive sections of the sample: the readout is on the host, which knows the
step.

The equations are written twice: in TensorFlow (:mod:`.network`, :mod:`.neurons`), and compiled
(:mod:`.gradient`, :mod:`.compiled`), with which networks are trained.
"""
