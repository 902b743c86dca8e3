/* The least that a loop can cost here: a frame in packets comes by UDP, the centroid of 7 by 7 pixels is
 * measured, a command goes out, and its confirmation comes back. The other side of the wire is a process of its
 * own, as fitctl's mocks are. Prints one line a frame: ns from the last packet to the command sent, from there to
 * its confirmation (both counted from the last packet), and from the last packet's departure to the command's arrival, which is the other side's.
 *
 * Usage: floor RATE_HZ SECONDS PRIORITY_OF_THE_LOOP PRIORITY_OF_THE_PEER
 */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <sched.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/socket.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

enum { SIDE = 40, HALF = 3, CHUNK = 1464, HEADER = 8, BYTES = 2 * SIDE * SIDE };
enum { PACKETS = 2 + (BYTES + CHUNK - 1) / CHUNK }; /* leader, pixels, trailer */

struct command {
    uint32_t frame;
    float volts[3];
    int64_t peer_ns; /* in the confirmation: last packet's departure to command's arrival */
};

static int64_t now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1000000000LL + t.tv_nsec;
}

static void become_realtime(int priority)
{
    struct sched_param wanted = {.sched_priority = priority};
    sched_setscheduler(0, SCHED_FIFO, &wanted); /* without the right to it, as all others here */
    prctl(PR_SET_TIMERSLACK, 1, 0, 0, 0);
    mlockall(MCL_CURRENT | MCL_FUTURE);
}

static int udp(struct sockaddr_in *own)
{
    int s = socket(AF_INET, SOCK_DGRAM, 0);
    socklen_t length = sizeof *own;
    struct timeval limit = {.tv_sec = 1};
    *own = (struct sockaddr_in){.sin_family = AF_INET, .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
    if (s < 0 || bind(s, (struct sockaddr *)own, sizeof *own) || getsockname(s, (struct sockaddr *)own, &length)) {
        perror("floor: socket on 127.0.0.1");
        exit(1);
    }
    setsockopt(s, SOL_SOCKET, SO_RCVTIMEO, &limit, sizeof limit);
    return s;
}

/* Camera and D/A: sends frames of a star near pixel (24, 19) at a pace, confirms each command. */
static void peer(int s, double rate_hz, long frames)
{
    uint8_t image[BYTES], packet[HEADER + CHUNK] = {0};
    uint16_t *pixels = (uint16_t *)image;
    struct command command;
    int64_t due_ns = now_ns();
    for (int i = 0; i < SIDE * SIDE; i++) {
        int x = i % SIDE - 24, y = i / SIDE - 19, r2 = x * x + y * y;
        pixels[i] = 1000 + (r2 < 9 ? 8000 / (1 + r2) : 0);
    }
    for (long frame = 0; frame < frames; frame++) {
        due_ns += (int64_t)(1e9 / rate_hz);
        struct timespec due = {due_ns / 1000000000LL, due_ns % 1000000000LL};
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, NULL);
        for (int i = 0; i < PACKETS; i++) {
            int start = (i - 1) * CHUNK;
            int size = i == 0 || i == PACKETS - 1 ? 0 : start + CHUNK > BYTES ? BYTES - start : CHUNK;
            memcpy(packet, &frame, 4);
            memcpy(packet + 4, &i, 4);
            memcpy(packet + HEADER, image + (size ? start : 0), size);
            send(s, packet, HEADER + size, 0);
        }
        int64_t departed_ns = now_ns();
        if (recv(s, &command, sizeof command, 0) != sizeof command) continue; /* counted by the loop */
        command.peer_ns = now_ns() - departed_ns;
        send(s, &command, sizeof command, 0);
    }
}

static void centroid(const uint16_t *pixels, int x0, int y0, double *x, double *y)
{
    double sum = 0, sx = 0, sy = 0;
    for (int dy = -HALF; dy <= HALF; dy++)
        for (int dx = -HALF; dx <= HALF; dx++) {
            double light = pixels[(y0 + dy) * SIDE + x0 + dx] - 1000.0;
            sum += light, sx += light * dx, sy += light * dy;
        }
    *x = x0 + sx / sum, *y = y0 + sy / sum;
}

int main(int count, char **words)
{
    if (count != 5) return fprintf(stderr, "usage: floor RATE_HZ SECONDS PRIORITY PEER_PRIORITY\n"), 2;
    double rate_hz = atof(words[1]), x, y;
    long frames = (long)(rate_hz * atof(words[2]));
    int64_t(*times)[3] = calloc(frames, sizeof *times);
    struct sockaddr_in own, other;
    int s = udp(&own), there = udp(&other), done = 0;
    if (connect(s, (struct sockaddr *)&other, sizeof other) || connect(there, (struct sockaddr *)&own, sizeof own))
        return perror("floor: connect"), 1;
    pid_t child = fork();
    if (child == 0) return become_realtime(atoi(words[4])), peer(there, rate_hz, frames), 0;
    become_realtime(atoi(words[3]));
    uint8_t image[BYTES], packet[HEADER + CHUNK];
    struct command command = {0};
    for (int number = 0; done < frames;) {
        ssize_t size = recvfrom(s, packet, sizeof packet, 0, NULL, NULL);
        if (size < HEADER) break; /* the peer has ended */
        memcpy(&number, packet + 4, 4);
        if (number > 0 && number < PACKETS - 1) memcpy(image + (number - 1) * CHUNK, packet + HEADER, size - HEADER);
        if (number != PACKETS - 1) continue;
        int64_t last_ns = now_ns();
        centroid((uint16_t *)image, 24, 19, &x, &y);
        for (int i = 0; i < 3; i++) command.volts[i] = 5 + 0.1f * ((x - 24) * (i - 1) + (y - 19.5) * (i == 1));
        sendto(s, &command, sizeof command, 0, NULL, 0);
        int64_t sent_ns = now_ns();
        if (recv(s, &command, sizeof command, 0) != sizeof command) break;
        int64_t confirmed_ns = now_ns();
        int64_t row[3] = {sent_ns - last_ns, confirmed_ns - last_ns, command.peer_ns};
        memcpy(times[done++], row, sizeof row);
    }
    wait(NULL);
    for (int i = 0; i < done; i++) printf("%ld %ld %ld\n", (long)times[i][0], (long)times[i][1], (long)times[i][2]);
    return done == frames ? 0 : (fprintf(stderr, "floor: %ld of %ld frames are missing\n", frames - done, frames), 1);
}
