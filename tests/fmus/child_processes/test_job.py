"""Job objects of Windows, against a stand-in for kernel32 that keeps the rules of its documentation."""

import ctypes

import pytest

from loopwright.fmus.child_processes.job import ExtendedLimits, Job, ThreadEntry

HANDLE, PID, OTHER = 40, 7, 8


class Kernel32:
    """Jobs, processes and threads by number; ``failing`` is a function that fails."""

    def __init__(self, failing=None):
        self.failing, self.handles, self.next = failing, {}, 100
        self.jobs, self.suspended, self.ended = {}, {70: PID, 80: OTHER, 71: PID}, set()

    def __getattribute__(self, name):
        if name[0].isupper() and name == self.failing:
            return lambda *arguments: 0
        return super().__getattribute__(name)

    def open(self, kind):
        self.next += 1
        self.handles[self.next] = kind
        return self.next

    def CreateJobObjectW(self, security, name):
        job = self.open("job")
        self.jobs[job] = {"flags": 0, "members": set()}
        return job

    def SetInformationJobObject(self, job, kind, limits, size):
        assert (kind, size) == (9, ctypes.sizeof(ExtendedLimits))
        self.jobs[job]["flags"] = limits._obj.BasicLimitInformation.LimitFlags
        return 1

    def AssignProcessToJobObject(self, job, process):
        assert PID in self.suspended.values()  # it has not begun
        self.jobs[job]["members"].add(process)
        return 1

    def CreateToolhelp32Snapshot(self, flags, process):
        assert flags == 4
        self.left = [*self.suspended.items()]
        return self.open("snapshot")

    def Thread32First(self, snapshot, entry):
        assert self.handles[snapshot] == "snapshot"
        assert entry._obj.dwSize == ctypes.sizeof(ThreadEntry) == 28
        if not self.left:
            return 0
        entry._obj.th32ThreadID, entry._obj.th32OwnerProcessID = self.left.pop(0)
        return 1

    Thread32Next = Thread32First

    def OpenThread(self, access, inherits, thread):
        assert access == 2
        return self.open(thread)

    def ResumeThread(self, handle):
        del self.suspended[self.handles[handle]]
        return 1

    def TerminateJobObject(self, job, status):
        self.ended |= self.jobs[job]["members"]
        return 1

    def CloseHandle(self, handle):
        if self.handles.pop(handle) == "job" and self.jobs[handle]["flags"] & 0x2000:
            self.ended |= self.jobs[handle]["members"]
        return 1


def test_a_process_begins_in_its_job_and_ends_with_it():
    kernel = Kernel32()
    job = Job(kernel)
    job.take(HANDLE, PID)
    assert kernel.suspended == {80: OTHER}
    assert kernel.handles == {101: "job"}  # all others are closed
    assert kernel.ended == set()
    kernel.CloseHandle(101)  # as Windows does when the host is gone
    assert kernel.ended == {HANDLE}


def test_the_end_of_a_job_closes_it_once():
    kernel = Kernel32()
    job = Job(kernel)
    job.take(HANDLE, PID)
    job.end()
    job.end()
    assert (kernel.ended, kernel.handles) == ({HANDLE}, {})
    with pytest.raises(ProcessLookupError):
        job.take(HANDLE, PID)


@pytest.mark.parametrize(
    "failing",
    ["SetInformationJobObject", "AssignProcessToJobObject", "CreateToolhelp32Snapshot", "Thread32First", "OpenThread"],
)
def test_a_function_that_fails_is_an_error_that_leaves_no_handle(failing):
    kernel = Kernel32(failing)

    def take():
        job = Job(kernel)
        try:
            job.take(HANDLE, PID)
        finally:
            job.end()

    with pytest.raises(OSError, match="failed"):
        take()
    assert kernel.handles == {}


@pytest.mark.skipif(ctypes.sizeof(ctypes.c_void_p) != 8, reason="sizes of 64-bit Windows")
def test_structures_have_the_sizes_of_64_bit_windows():
    assert ctypes.sizeof(ExtendedLimits) == 144
    assert ExtendedLimits.ProcessMemoryLimit.offset == 112
