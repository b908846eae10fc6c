"""The same function for many numbers: on processes of this machine, or as Ray tasks on many."""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context, parent_process
from typing import Any, TypeVar

import torch

Result = TypeVar("Result")
_DIED = "perhaps for want of memory; what is finished is kept, run the same command to go on"


def in_processes(function: Callable[[int], Result], numbers: Sequence[int], workers: int) -> Iterator[Result]:
    """Call a function for many numbers in processes of one thread each.

    Args:
        function: The function; it must be picklable.
        numbers: The numbers.
        workers: Number of processes.

    Returns:
        Results, as they come.

    Raises:
        RuntimeError: A process died.
    """
    with _one_thread(), ProcessPoolExecutor(workers, get_context("spawn"), _prepare) as pool:
        try:
            for job in as_completed([pool.submit(function, number) for number in numbers]):
                yield job.result()
        except BrokenProcessPool:
            raise RuntimeError(f"a worker process died, {_DIED}") from None
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def on_ray(function: Callable[[int], Result], numbers: Sequence[int], address: str) -> Iterator[Result]:
    """Call a function for many numbers in Ray tasks of one processor each; all machines need this dexzoo installed.

    Args:
        function: The function; it must be picklable.
        numbers: The numbers.
        address: "auto" for the cluster that this machine belongs to, a cluster's address, or "local" for one made here.

    Returns:
        Results, as they come.

    Raises:
        RuntimeError: Ray is not installed, the cluster is not reached, or tasks are lost for good.
    """
    try:
        import ray
    except ImportError:
        raise RuntimeError("--ray needs the package ray; install it with pip install 'dexzoo[ray]'") from None
    try:
        ray.init(address, log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise RuntimeError(f"no Ray cluster is reached at {address!r}: {reason}; --ray local makes one here") from None
    try:
        task: Any = ray.remote(num_cpus=1)(_call)
        pending = [task.remote(function, number) for number in numbers]
        while pending:
            done, pending = ray.wait(pending)
            yield ray.get(done[0])
    except ray.exceptions.RayTaskError as error:
        raise error.cause from None
    except ray.exceptions.RayError as error:
        raise RuntimeError(f"Ray lost a task ({type(error).__name__}), {_DIED}") from None
    finally:
        ray.shutdown()


def _call(function: Callable[[int], Result], number: int) -> Result:
    torch.set_num_threads(1)
    return function(number)


def _prepare() -> None:
    """One thread, and an end when the parent is killed, which the pool alone would not notice."""
    torch.set_num_threads(1)
    threading.Thread(target=_follow_parent, daemon=True).start()


def _follow_parent() -> None:
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Processes started meanwhile use one thread for each library: the sums of more may round otherwise."""
    before = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ["OMP_NUM_THREADS"]
        else:
            os.environ["OMP_NUM_THREADS"] = before
