"""Stops one thread of a process, as a disk that stalls stops the thread that writes to it.

usage: hold_thread.py PID NAME

Prints "holding" once ptrace has stopped the thread, and resumes it at SIGINT or at the end of this program. Without
the permission to trace (kernel.yama.ptrace_scope over 0, and not root) it prints "not allowed" and exits with 77.
"""

import ctypes
import os
import signal
import sys

PTRACE_DETACH, PTRACE_SEIZE, PTRACE_INTERRUPT = 17, 0x4206, 0x4207
WALL = 0x40000000


def ptrace(request, thread):
    libc = ctypes.CDLL(None, use_errno=True)
    libc.ptrace.argtypes = [ctypes.c_long] * 4
    if libc.ptrace(request, thread, 0, 0) != 0:
        error = ctypes.get_errno()
        raise OSError(error, os.strerror(error))


def thread_of(process, name):
    for thread in os.listdir(f"/proc/{process}/task"):
        with open(f"/proc/{process}/task/{thread}/comm") as comm:
            if comm.read().strip() == name:
                return int(thread)
    raise LookupError(f"process {process} has no thread {name}")


def main():
    process, name = int(sys.argv[1]), sys.argv[2]
    thread = thread_of(process, name)
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        ptrace(PTRACE_SEIZE, thread)
    except PermissionError as error:
        print(f"not allowed: {error}", flush=True)
        return 77
    ptrace(PTRACE_INTERRUPT, thread)
    os.waitpid(thread, WALL)
    print("holding", flush=True)
    signal.sigwait([signal.SIGINT])
    ptrace(PTRACE_DETACH, thread)
    return 0


if __name__ == "__main__":
    sys.exit(main())
