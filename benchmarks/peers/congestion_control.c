/* Preloaded into a program that cannot configure its TCP congestion control: every TCP socket it opens uses the one in
 * BENCHMARK_CONGESTION_CONTROL, because the kernel's default differs between machines.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>

int socket(int domain, int type, int protocol)
{
    int (*real)(int, int, int) = (int (*)(int, int, int))dlsym(RTLD_NEXT, "socket");
    int made = real(domain, type, protocol);
    const char *wanted = getenv("BENCHMARK_CONGESTION_CONTROL");
    if (made >= 0 && wanted && (domain == AF_INET || domain == AF_INET6) && (type & 0xf) == SOCK_STREAM)
        setsockopt(made, IPPROTO_TCP, TCP_CONGESTION, wanted, (socklen_t)strlen(wanted));
    return made;
}
