/* What libmodbus makes of the D/A mock: one line for each request, for tests/peers/test_libmodbus.py. */

#include <errno.h>
#include <modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static void tell(const char *request, int done, const uint16_t *values)
{
    printf("%s:", request);
    if (done < 0)
        printf(" %s", modbus_strerror(errno));
    for (int place = 0; place < done; place++)
        printf(" %u", values[place]);
    printf("\n");
}

int main(int count, char **arguments)
{
    if (count != 3) {
        fprintf(stderr, "usage: %s tcp PORT | rtu DEVICE\n", arguments[0]);
        return 2;
    }
    modbus_t *link = strcmp(arguments[1], "tcp") == 0
                         ? modbus_new_tcp("127.0.0.1", atoi(arguments[2]))
                         : modbus_new_rtu(arguments[2], 115200, 'N', 8, 2);
    uint16_t written[] = {0, 32768, 65535};
    uint16_t two[] = {11, 22};
    uint16_t read[125] = {0};

    if (link == NULL || modbus_set_slave(link, 1) < 0 || modbus_connect(link) < 0) {
        fprintf(stderr, "cannot connect: %s\n", modbus_strerror(errno));
        return 1;
    }
    modbus_set_response_timeout(link, 2, 0);
    tell("read", modbus_read_registers(link, 0, 3, read), read);
    tell("write all", modbus_write_registers(link, 0, 3, written), written);
    tell("read", modbus_read_registers(link, 0, 3, read), read);
    tell("write one", modbus_write_register(link, 1, 99), &written[1]);
    tell("write and read", modbus_write_and_read_registers(link, 1, 2, two, 0, 3, read), read);
    tell("read beyond", modbus_read_registers(link, 3, 1, read), read);
    tell("write beyond", modbus_write_registers(link, 1, 3, written), written);
    tell("input registers", modbus_read_input_registers(link, 0, 1, read), read);
    tell("coils", modbus_write_bit(link, 0, 1), written);
    tell("mask", modbus_mask_write_register(link, 0, 0xF0, 0x0F), written);
    tell("read", modbus_read_registers(link, 0, 3, read), read);
    modbus_close(link);
    modbus_free(link);
    return 0;
}
