"""Job objects of Windows: processes that end with the handle of their job, which the host alone has.

Windows closes the handles of a process that ends, in whatever way, and JOB_OBJECT_LIMIT_KILL_ON_JOB_CLOSE ends all
processes of a job whose last handle is closed. Processes that a member starts belong to the job, too. A process begins
suspended, is assigned to the job, and then resumed: at no moment could it start another one outside. Jobs are nested
since Windows 8, so that a host that is in a job itself can have some.
(learn.microsoft.com: Job Objects; AssignProcessToJobObject; JOBOBJECT_BASIC_LIMIT_INFORMATION; Thread32First)

It is tested with a stand-in for kernel32 alone, on Linux; it has not run on Windows.
"""

from __future__ import annotations

import ctypes
from typing import Any

CREATE_SUSPENDED, CREATE_NEW_PROCESS_GROUP = 0x4, 0x200
_EXTENDED_LIMITS, _KILL_ON_CLOSE = 9, 0x2000
_SNAP_THREADS, _SUSPEND_RESUME = 0x4, 0x2
_ENDED = 1  # exit status of processes that are ended
_INVALID = ctypes.c_void_p(-1).value


class _BasicLimits(ctypes.Structure):
    _fields_ = (
        ("PerProcessUserTimeLimit", ctypes.c_int64),
        ("PerJobUserTimeLimit", ctypes.c_int64),
        ("LimitFlags", ctypes.c_uint32),
        ("MinimumWorkingSetSize", ctypes.c_size_t),
        ("MaximumWorkingSetSize", ctypes.c_size_t),
        ("ActiveProcessLimit", ctypes.c_uint32),
        ("Affinity", ctypes.c_size_t),
        ("PriorityClass", ctypes.c_uint32),
        ("SchedulingClass", ctypes.c_uint32),
    )


class ExtendedLimits(ctypes.Structure):
    """JOBOBJECT_EXTENDED_LIMIT_INFORMATION."""

    _fields_ = (
        ("BasicLimitInformation", _BasicLimits),
        ("IoInfo", ctypes.c_uint64 * 6),
        ("ProcessMemoryLimit", ctypes.c_size_t),
        ("JobMemoryLimit", ctypes.c_size_t),
        ("PeakProcessMemoryUsed", ctypes.c_size_t),
        ("PeakJobMemoryUsed", ctypes.c_size_t),
    )


class ThreadEntry(ctypes.Structure):
    """THREADENTRY32."""

    _fields_ = (
        ("dwSize", ctypes.c_uint32),
        ("cntUsage", ctypes.c_uint32),
        ("th32ThreadID", ctypes.c_uint32),
        ("th32OwnerProcessID", ctypes.c_uint32),
        ("tpBasePri", ctypes.c_int32),
        ("tpDeltaPri", ctypes.c_int32),
        ("dwFlags", ctypes.c_uint32),
    )


def load_kernel32() -> Any:
    """Return the functions of kernel32 with their types: a handle is a pointer, and none of them is cut to 32 bits."""
    library: Any = ctypes.WinDLL("kernel32", use_last_error=True)  # type: ignore[attr-defined]
    handle, number, flag = ctypes.c_void_p, ctypes.c_uint32, ctypes.c_int
    for name, result, *arguments in (
        ("CreateJobObjectW", handle, handle, ctypes.c_wchar_p),
        ("SetInformationJobObject", flag, handle, flag, handle, number),
        ("AssignProcessToJobObject", flag, handle, handle),
        ("TerminateJobObject", flag, handle, ctypes.c_uint),
        ("CloseHandle", flag, handle),
        ("CreateToolhelp32Snapshot", handle, number, number),
        ("Thread32First", flag, handle, handle),
        ("Thread32Next", flag, handle, handle),
        ("OpenThread", handle, number, flag, number),
        ("ResumeThread", number, handle),
    ):
        function = library[name]
        function.restype, function.argtypes = result, arguments
    return library


class Job:
    """A job object, whose processes end with this process; an `OSError` if it can't be made."""

    def __init__(self, kernel32: Any = None):
        self._kernel = load_kernel32() if kernel32 is None else kernel32
        self._handle: int | None = self._check(self._kernel.CreateJobObjectW(None, None), "CreateJobObject")
        limits = ExtendedLimits()
        limits.BasicLimitInformation.LimitFlags = _KILL_ON_CLOSE
        size = ctypes.sizeof(limits)
        try:
            made = self._kernel.SetInformationJobObject(self._handle, _EXTENDED_LIMITS, ctypes.byref(limits), size)
            self._check(made, "SetInformationJobObject")
        except OSError:
            self.end()
            raise

    def _check(self, result: Any, name: str) -> Any:
        if not result or result == _INVALID:
            code = getattr(ctypes, "get_last_error", int)()
            raise OSError(code, f"{name} failed (Windows error {code})")
        return result

    def take(self, process: int, pid: int) -> None:
        """Take in a process that was started suspended, by its handle and number, and let it begin."""
        if self._handle is None:
            raise ProcessLookupError("its group of processes has ended")
        self._check(self._kernel.AssignProcessToJobObject(self._handle, process), "AssignProcessToJobObject")
        threads = self._check(self._kernel.CreateToolhelp32Snapshot(_SNAP_THREADS, 0), "CreateToolhelp32Snapshot")
        resumed = 0
        try:
            entry = ThreadEntry(dwSize=ctypes.sizeof(ThreadEntry))
            found = self._kernel.Thread32First(threads, ctypes.byref(entry))
            while found:
                if entry.th32OwnerProcessID == pid:
                    resumed += self._resume(entry.th32ThreadID)
                entry.dwSize = ctypes.sizeof(ThreadEntry)
                found = self._kernel.Thread32Next(threads, ctypes.byref(entry))
        finally:
            self._kernel.CloseHandle(threads)
        self._check(resumed, "ResumeThread")

    def _resume(self, number: int) -> int:
        """Resume a thread, and return 1."""
        thread = self._check(self._kernel.OpenThread(_SUSPEND_RESUME, 0, number), "OpenThread")
        self._kernel.ResumeThread(thread)
        self._kernel.CloseHandle(thread)
        return 1

    def kill(self) -> None:
        """End all processes of the job."""
        if self._handle is not None:
            self._kernel.TerminateJobObject(self._handle, _ENDED)

    def end(self) -> None:
        """End all processes of the job, and close it."""
        self.kill()
        if self._handle is not None:
            self._kernel.CloseHandle(self._handle)
            self._handle = None
