# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""The process of a task: `python -m slam_graph.experiment.task_process TASK`."""

from __future__ import annotations

import gc


def main() -> None:
    """Import what tasks need, and do the one that is given."""
    gc.disable()
    from slam_graph.experiment.tasks import do_given_task

    gc.freeze()  # no collection looks at all that was imported
    gc.enable()
    do_given_task()
    gc.freeze()  # nor does the one at the end of the interpreter: tasks close what they write


if __name__ == "__main__":
    main()
