/*
 * Preloaded into linux.uml. Its kernel, 6.1, sets a process's floating-point registers from a buffer of
 * fixed size, which newer processors' state (AMX) does not fit: the host then answers EFAULT.
 * Here the rest of the state is filled up with what the process has, AMX left out.
 */
#define _GNU_SOURCE
#include <stdarg.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/syscall.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <elf.h>
#include <stdint.h>
#include <unistd.h>

#ifndef NT_X86_XSTATE
#define NT_X86_XSTATE 0x202
#endif
#define AMX (UINT64_C(3) << 17)
#define XSTATE_BV 512 /* offset of the mask of components in the XSAVE area */

static char whole[1 << 16];

long ptrace(enum __ptrace_request request, ...)
{
	va_list rest;
	va_start(rest, request);
	pid_t pid = va_arg(rest, pid_t);
	void *address = va_arg(rest, void *);
	void *data = va_arg(rest, void *);
	va_end(rest);

	long word = 0;
	if (request == PTRACE_PEEKTEXT || request == PTRACE_PEEKDATA || request == PTRACE_PEEKUSER)
		return syscall(SYS_ptrace, request, pid, address, &word) < 0 ? -1 : word;
	if (request != PTRACE_SETREGSET || (uintptr_t)address != NT_X86_XSTATE)
		return syscall(SYS_ptrace, request, pid, address, data);

	struct iovec *given = data, full = {whole, sizeof whole};
	if (syscall(SYS_ptrace, PTRACE_GETREGSET, pid, address, &full) < 0)
		return -1;
	memcpy(whole, given->iov_base, given->iov_len < full.iov_len ? given->iov_len : full.iov_len);
	uint64_t components;
	memcpy(&components, whole + XSTATE_BV, sizeof components);
	components &= ~AMX;
	memcpy(whole + XSTATE_BV, &components, sizeof components);
	return syscall(SYS_ptrace, request, pid, address, &full);
}
