# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Loops over features and observations that NumPy has no call for, compiled by Numba.

Each kernel stands beside its NumPy form, `<name>_numpy`, which is its specification (a long one in
a file `<file>_numpy.py`): a law test holds both to 1e-12 of each other. Kernels take and fill plain
arrays, know nothing of the estimator and raise nothing. Callers import the module of a kernel, so
that what needs none does not import Numba.
"""
