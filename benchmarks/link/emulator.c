/* An Ethernet link emulator between network namespaces, in user space.
 *
 * usage: emulator SOCKET SEED NAMESPACE:INTERFACE NAMESPACE:INTERFACE [...]
 *
 * Each NAMESPACE:INTERFACE becomes a TAP device, a port. A frame read from a port goes, in order, through
 *   1. the port's drop-tail queue (queue frames),
 *   2. the transmitter: one per port, or one that all ports share when half=1; it is busy for
 *      IP bytes * 8 / rate + overhead_us, once per attempt; a lost unicast attempt is repeated up to attempts times,
 *      as a radio's own acknowledgments do,
 *   3. loss: independent (loss), or in bursts by a two-state Gilbert-Elliott chain per port (burst_enter and
 *      burst_leave per frame, burst_loss inside a burst),
 *   4. the delay line (delay_ms), and out of the port that has the destination's address, or of all others.
 * Broadcast is attempted once and lost per receiver. With up=0 every frame that would leave is lost, and so is one whose
 * source and destination are in different groups (all ports begin in group 0).
 *
 * Control: one datagram per command on the Unix socket SOCKET; the answer goes to the sender's bound address.
 *   set key=value ...   rate (bit/s) delay_ms loss burst_enter burst_leave burst_loss queue overhead_us attempts half up
 *   groups N N ...      the group of each port
 *   count               the counters as JSON, and how many frames are on their way
 *   reset               counters to zero
 *   quit
 */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <linux/if.h>
#include <linux/if_tun.h>
#include <poll.h>
#include <sched.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/prctl.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

enum { MAX_PORTS = 32, MAX_QUEUE = 32768, MAX_STATIONS = 256, ETHERNET_HEADER = 14, READ_BURST = 64 };
static const uint64_t SECOND_NS = 1000000000ull;

struct frame {
    uint64_t arrived_ns;
    int length;
    int source;
    uint8_t bytes[];
};

struct port {
    int descriptor;
    struct frame *queue[MAX_QUEUE];
    int head, waiting, group;
    uint64_t busy_until_ns;
    int in_burst;
    uint64_t in_frames, in_bytes, queue_drops, losses, down_drops, out_frames, out_bytes, max_waiting;
};

struct delivery {
    uint64_t at_ns, order;
    int port;
    struct frame *frame;
};

static struct {
    double rate, delay_ms, loss, burst_enter, burst_leave, burst_loss, queue, overhead_us, attempts, half, up;
} link_is = {.rate = 10e6, .delay_ms = 10, .burst_loss = 1, .burst_leave = 1, .queue = 100, .attempts = 1, .up = 1};

static const struct {
    const char *name;
    double *value;
} settings[] = {
    {"rate", &link_is.rate},
    {"delay_ms", &link_is.delay_ms},
    {"loss", &link_is.loss},
    {"burst_enter", &link_is.burst_enter},
    {"burst_leave", &link_is.burst_leave},
    {"burst_loss", &link_is.burst_loss},
    {"queue", &link_is.queue},
    {"overhead_us", &link_is.overhead_us},
    {"attempts", &link_is.attempts},
    {"half", &link_is.half},
    {"up", &link_is.up},
};

static struct port ports[MAX_PORTS];
static int port_count;
static struct { uint8_t address[6]; int port; } stations[MAX_STATIONS];
static int station_count;
static uint64_t shared_busy_until_ns, airtime_ns;
static int next_turn;

static void die(const char *what)
{
    perror(what);
    exit(1);
}

static uint64_t now_ns(void)
{
    struct timespec time;
    clock_gettime(CLOCK_MONOTONIC, &time);
    return (uint64_t)time.tv_sec * SECOND_NS + (uint64_t)time.tv_nsec;
}

/* xorshift64: the same seed gives the same losses for the same sequence of frames */
static uint64_t random_state;
static double uniform(void)
{
    random_state ^= random_state << 13;
    random_state ^= random_state >> 7;
    random_state ^= random_state << 17;
    return (double)(random_state >> 11) / 9007199254740992.0;
}

/* ---- the delay line: a binary heap ordered by time, then by entry */

static struct delivery *heap;
static size_t heap_size, heap_room;
static uint64_t deliveries;

static int earlier(const struct delivery *a, const struct delivery *b)
{
    return a->at_ns < b->at_ns || (a->at_ns == b->at_ns && a->order < b->order);
}

static void swap(size_t a, size_t b)
{
    struct delivery kept = heap[a];
    heap[a] = heap[b];
    heap[b] = kept;
}

static void schedule(uint64_t at_ns, int port, struct frame *frame)
{
    if (heap_size == heap_room) {
        heap_room = heap_room ? heap_room * 2 : 1024;
        heap = realloc(heap, heap_room * sizeof *heap);
        if (!heap)
            die("realloc");
    }
    size_t at = heap_size++;
    heap[at] = (struct delivery){at_ns, deliveries++, port, frame};
    for (; at && earlier(&heap[at], &heap[(at - 1) / 2]); at = (at - 1) / 2)
        swap(at, (at - 1) / 2);
}

static struct delivery take_first(void)
{
    struct delivery first = heap[0];
    heap[0] = heap[--heap_size];
    for (size_t at = 0;;) {
        size_t least = at;
        for (size_t child = 2 * at + 1; child <= 2 * at + 2; child++)
            if (child < heap_size && earlier(&heap[child], &heap[least]))
                least = child;
        if (least == at)
            return first;
        swap(at, least);
        at = least;
    }
}

/* ---- stations: which port an address was last seen on */

static int port_of(const uint8_t *address)
{
    for (int i = 0; i < station_count; i++)
        if (!memcmp(stations[i].address, address, 6))
            return stations[i].port;
    return -1;
}

static void learn(const uint8_t *address, int port)
{
    for (int i = 0; i < station_count; i++)
        if (!memcmp(stations[i].address, address, 6)) {
            stations[i].port = port;
            return;
        }
    if (station_count < MAX_STATIONS) {
        memcpy(stations[station_count].address, address, 6);
        stations[station_count++].port = port;
    }
}

/* ---- the transmitter */

static int is_lost(struct port *port)
{
    if (link_is.burst_enter > 0) {
        if (port->in_burst)
            port->in_burst = uniform() >= link_is.burst_leave;
        else
            port->in_burst = uniform() < link_is.burst_enter;
        if (port->in_burst && uniform() < link_is.burst_loss)
            return 1;
    }
    return link_is.loss > 0 && uniform() < link_is.loss;
}

static void broadcast(struct frame *frame, uint64_t at_ns)
{
    for (int to = 0; to < port_count; to++) {
        if (to == frame->source)
            continue;
        if (is_lost(&ports[frame->source])) {
            ports[frame->source].losses++;
            continue;
        }
        size_t size = sizeof *frame + (size_t)frame->length;
        struct frame *copy = malloc(size);
        if (!copy)
            die("malloc");
        memcpy(copy, frame, size);
        schedule(at_ns, to, copy);
    }
    free(frame);
}

static void transmit_next(struct port *port, uint64_t *busy_until_ns)
{
    struct frame *frame = port->queue[port->head];
    port->head = (port->head + 1) % MAX_QUEUE;
    port->waiting--;
    int to_all = frame->bytes[0] & 1, to = to_all ? -1 : port_of(frame->bytes);
    uint64_t start = *busy_until_ns > frame->arrived_ns ? *busy_until_ns : frame->arrived_ns;
    uint64_t attempt_ns =
        (uint64_t)((frame->length - ETHERNET_HEADER) * 8e9 / link_is.rate + link_is.overhead_us * 1e3);
    int attempts = 1, lost = 0;
    if (!to_all)
        while ((lost = is_lost(port)) && attempts < link_is.attempts)
            attempts++;
    uint64_t end = start + attempt_ns * (uint64_t)attempts;
    *busy_until_ns = end;
    airtime_ns += attempt_ns * (uint64_t)attempts;
    uint64_t at_ns = end + (uint64_t)(link_is.delay_ms * 1e6);
    if (link_is.up == 0) {
        port->down_drops++;
        free(frame);
    } else if (lost) {
        port->losses++;
        free(frame);
    } else if (to_all || to < 0) {
        broadcast(frame, at_ns);
    } else if (to == frame->source) {
        free(frame);
    } else {
        schedule(at_ns, to, frame);
    }
}

/* start every transmission that begins at or before `time_ns` */
static void advance(uint64_t time_ns)
{
    if (!link_is.half) {
        for (int i = 0; i < port_count; i++)
            while (ports[i].waiting && ports[i].busy_until_ns <= time_ns)
                transmit_next(&ports[i], &ports[i].busy_until_ns);
        return;
    }
    while (shared_busy_until_ns <= time_ns) {
        int i = 0;
        while (i < port_count && !ports[(next_turn + i) % port_count].waiting)
            i++;
        if (i == port_count)
            return;
        int turn = (next_turn + i) % port_count;
        next_turn = (turn + 1) % port_count;
        transmit_next(&ports[turn], &shared_busy_until_ns);
    }
}

static void deliver(uint64_t time_ns)
{
    while (heap_size && heap[0].at_ns <= time_ns) {
        struct delivery due = take_first();
        struct port *to = &ports[due.port], *from = &ports[due.frame->source];
        if (link_is.up == 0 || from->group != to->group) {
            from->down_drops++;
        } else if (write(to->descriptor, due.frame->bytes, (size_t)due.frame->length) > 0) {
            to->out_frames++;
            to->out_bytes += (uint64_t)(due.frame->length - ETHERNET_HEADER);
        }
        free(due.frame);
    }
}

static void read_port(int index)
{
    static uint8_t bytes[65536 + 64];
    struct port *port = &ports[index];
    for (int burst = 0; burst < READ_BURST; burst++) {
        ssize_t length = read(port->descriptor, bytes, sizeof bytes);
        if (length < ETHERNET_HEADER)
            return;
        learn(bytes + 6, index);
        uint64_t time_ns = now_ns();
        advance(time_ns);
        port->in_frames++;
        port->in_bytes += (uint64_t)(length - ETHERNET_HEADER);
        if (port->waiting >= link_is.queue || port->waiting >= MAX_QUEUE - 1) {
            port->queue_drops++;
            continue;
        }
        struct frame *frame = malloc(sizeof *frame + (size_t)length);
        if (!frame)
            die("malloc");
        frame->arrived_ns = time_ns;
        frame->length = (int)length;
        frame->source = index;
        memcpy(frame->bytes, bytes, (size_t)length);
        port->queue[(port->head + port->waiting++) % MAX_QUEUE] = frame;
        if ((uint64_t)port->waiting > port->max_waiting)
            port->max_waiting = (uint64_t)port->waiting;
        advance(time_ns);
    }
}

/* ---- control */

static char answer[16384];
static size_t answer_length;

__attribute__((format(printf, 1, 2))) static void say(const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    answer_length +=
        (size_t)vsnprintf(answer + answer_length, sizeof answer - answer_length, format, arguments);
    va_end(arguments);
}

static void set(char *assignments)
{
    for (char *word = strtok(assignments, " \n"); word; word = strtok(NULL, " \n")) {
        char *equals = strchr(word, '=');
        size_t i = 0, known = sizeof settings / sizeof settings[0];
        if (equals)
            for (*equals = 0; i < known && strcmp(settings[i].name, word);)
                i++;
        if (!equals || i == known) {
            say("unknown setting %.80s", word);
            return;
        }
        *settings[i].value = atof(equals + 1);
    }
    say("ok");
}

static void set_groups(char *numbers)
{
    int groups[MAX_PORTS], found = 0;
    for (char *word = strtok(numbers, " \n"); word && found < MAX_PORTS; word = strtok(NULL, " \n"))
        groups[found++] = atoi(word);
    if (found != port_count) {
        say("expected %d groups, found %d", port_count, found);
        return;
    }
    for (int i = 0; i < port_count; i++)
        ports[i].group = groups[i];
    say("ok");
}

static void count(void)
{
    int in_flight = (int)heap_size;
    for (int i = 0; i < port_count; i++)
        in_flight += ports[i].waiting;
    say("{\"airtime_ns\":%llu,\"in_flight\":%d,\"ports\":[", (unsigned long long)airtime_ns, in_flight);
    for (int i = 0; i < port_count; i++) {
        struct port *port = &ports[i];
        say("%s{\"in_frames\":%llu,\"in_bytes\":%llu,\"queue_drops\":%llu,\"losses\":%llu,\"down_drops\":%llu,"
            "\"out_frames\":%llu,\"out_bytes\":%llu,\"max_waiting\":%llu}",
            i ? "," : "", (unsigned long long)port->in_frames, (unsigned long long)port->in_bytes,
            (unsigned long long)port->queue_drops, (unsigned long long)port->losses,
            (unsigned long long)port->down_drops, (unsigned long long)port->out_frames,
            (unsigned long long)port->out_bytes, (unsigned long long)port->max_waiting);
    }
    say("]}");
}

static void reset(void)
{
    airtime_ns = 0;
    for (int i = 0; i < port_count; i++) {
        struct port *port = &ports[i];
        port->in_frames = port->in_bytes = port->queue_drops = port->losses = 0;
        port->down_drops = port->out_frames = port->out_bytes = port->max_waiting = 0;
    }
    say("ok");
}

static void obey(int control)
{
    struct sockaddr_un from;
    socklen_t from_length = sizeof from;
    char command[1024];
    ssize_t length = recvfrom(control, command, sizeof command - 1, 0, (struct sockaddr *)&from, &from_length);
    if (length <= 0)
        return;
    command[length] = 0;
    answer_length = 0;
    if (!strncmp(command, "set ", 4))
        set(command + 4);
    else if (!strncmp(command, "groups ", 7))
        set_groups(command + 7);
    else if (!strcmp(command, "count"))
        count();
    else if (!strcmp(command, "reset"))
        reset();
    else if (!strcmp(command, "quit"))
        exit(0);
    else
        say("unknown command");
    if (from_length > sizeof(sa_family_t))
        sendto(control, answer, answer_length, 0, (struct sockaddr *)&from, from_length);
}

/* ---- set-up and the loop */

static int open_port(char *where)
{
    char path[300], *interface = strchr(where, ':');
    if (!interface) {
        fprintf(stderr, "expected NAMESPACE:INTERFACE, found %s\n", where);
        exit(2);
    }
    *interface++ = 0;
    snprintf(path, sizeof path, "/var/run/netns/%s", where);
    int space = open(path, O_RDONLY | O_CLOEXEC);
    if (space < 0 || setns(space, CLONE_NEWNET))
        die(path);
    close(space);
    int descriptor = open("/dev/net/tun", O_RDWR | O_NONBLOCK | O_CLOEXEC);
    struct ifreq request = {.ifr_flags = IFF_TAP | IFF_NO_PI};
    strncpy(request.ifr_name, interface, IFNAMSIZ - 1);
    if (descriptor < 0 || ioctl(descriptor, TUNSETIFF, &request))
        die(interface);
    return descriptor;
}

static int open_control(const char *path)
{
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    strncpy(address.sun_path, path, sizeof address.sun_path - 1);
    unlink(path);
    int control = socket(AF_UNIX, SOCK_DGRAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
    if (control < 0 || bind(control, (struct sockaddr *)&address, sizeof address))
        die(path);
    return control;
}

static uint64_t next_event_ns(uint64_t time_ns)
{
    uint64_t next = time_ns + SECOND_NS;
    if (heap_size && heap[0].at_ns < next)
        next = heap[0].at_ns;
    for (int i = 0; i < port_count; i++) {
        uint64_t busy = link_is.half ? shared_busy_until_ns : ports[i].busy_until_ns;
        if (ports[i].waiting && busy < next)
            next = busy;
    }
    return next;
}

int main(int argument_count, char **arguments)
{
    if (argument_count < 5 || argument_count - 3 > MAX_PORTS) {
        fprintf(stderr, "usage: emulator SOCKET SEED NAMESPACE:INTERFACE NAMESPACE:INTERFACE [...]\n");
        return 2;
    }
    prctl(PR_SET_TIMERSLACK, 1000);
    prctl(PR_SET_PDEATHSIG, 15);
    random_state = strtoull(arguments[2], NULL, 10) * 0x9E3779B97F4A7C15ull + 88172645463325252ull;
    int control = open_control(arguments[1]);
    for (port_count = 0; port_count < argument_count - 3; port_count++)
        ports[port_count].descriptor = open_port(arguments[3 + port_count]);
    struct pollfd polled[MAX_PORTS + 1];
    for (int i = 0; i < port_count; i++)
        polled[i] = (struct pollfd){ports[i].descriptor, POLLIN, 0};
    polled[port_count] = (struct pollfd){control, POLLIN, 0};
    puts("ready");
    fflush(stdout);
    for (;;) {
        uint64_t time_ns = now_ns();
        advance(time_ns);
        deliver(time_ns);
        uint64_t next = next_event_ns(time_ns);
        time_ns = now_ns();
        uint64_t wait_ns = next > time_ns ? next - time_ns : 0;
        struct timespec wait = {(time_t)(wait_ns / SECOND_NS), (long)(wait_ns % SECOND_NS)};
        if (ppoll(polled, (nfds_t)port_count + 1, &wait, NULL) <= 0)
            continue;
        for (int i = 0; i < port_count; i++)
            if (polled[i].revents & POLLIN)
                read_port(i);
        if (polled[port_count].revents & POLLIN)
            obey(control);
    }
}
