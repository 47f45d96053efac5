/* Floods a UDP port at a fixed rate: flood FROM TO PORT RATE SECONDS LENGTH PREFIX
 *
 * PREFIX is the hexadecimal beginning of each datagram; the rest, up to LENGTH bytes, is random. Prints the number of
 * datagrams sent. */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>

#define BATCH 16
#define LONGEST 1500

static uint64_t state = 88172645463325252ull;

static uint64_t draw(void) {
    state ^= state << 13;
    state ^= state >> 7;
    return state ^= state << 17;
}

static double now_s(void) {
    struct timespec at;
    clock_gettime(CLOCK_MONOTONIC, &at);
    return at.tv_sec + at.tv_nsec * 1e-9;
}

static struct sockaddr_in address(const char *text, int port) {
    struct sockaddr_in found = {.sin_family = AF_INET, .sin_port = htons(port)};
    if (inet_pton(AF_INET, text, &found.sin_addr) != 1) {
        fprintf(stderr, "expected an IPv4 address, found %s\n", text);
        exit(2);
    }
    return found;
}

int main(int count, char **arguments) {
    if (count != 8) {
        fprintf(stderr, "usage: flood FROM TO PORT RATE SECONDS LENGTH PREFIX\n");
        return 2;
    }
    struct sockaddr_in from = address(arguments[1], 0), to = address(arguments[2], atoi(arguments[3]));
    double rate = atof(arguments[4]), seconds = atof(arguments[5]);
    size_t length = atoi(arguments[6]), prefix = strlen(arguments[7]) / 2;
    static uint8_t data[BATCH][LONGEST + 8];
    if (length > LONGEST || prefix > length || rate <= 0) {
        fprintf(stderr, "expected PREFIX within LENGTH <= %d bytes and a positive RATE\n", LONGEST);
        return 2;
    }
    struct iovec parts[BATCH];
    struct mmsghdr messages[BATCH];
    memset(messages, 0, sizeof messages);
    for (int place = 0; place < BATCH; place++) {
        for (size_t at = 0; at < prefix; at++)
            sscanf(arguments[7] + 2 * at, "%2hhx", &data[place][at]);
        parts[place] = (struct iovec){data[place], length};
        messages[place].msg_hdr = (struct msghdr){
            .msg_name = &to, .msg_namelen = sizeof to, .msg_iov = &parts[place], .msg_iovlen = 1};
    }
    int sender = socket(AF_INET, SOCK_DGRAM, 0);
    if (sender < 0 || bind(sender, (struct sockaddr *)&from, sizeof from)) {
        perror(arguments[1]);
        return 1;
    }
    double start = now_s(), until = start + seconds;
    uint64_t sent = 0;
    for (;;) {
        double now = now_s();
        if (now >= until)
            break;
        double ahead = sent / rate - (now - start);
        if (ahead > 0) {
            struct timespec pause = {.tv_nsec = (long)(ahead < 0.01 ? ahead * 1e9 : 1e7)};
            nanosleep(&pause, NULL);
            continue;
        }
        for (int place = 0; place < BATCH; place++)
            for (size_t at = prefix; at < length; at += 8) {
                uint64_t value = draw();
                memcpy(data[place] + at, &value, 8);
            }
        /* refused datagrams (an ICMP error of a closed port) count as sent: the attacker did its work */
        if (sendmmsg(sender, messages, BATCH, 0) < 0)
            continue;
        sent += BATCH;
    }
    printf("%llu\n", (unsigned long long)sent);
    return 0;
}
