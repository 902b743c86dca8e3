/* What libmodbus makes of the LabJack T7 mock: one line for each request, for tests/peers/test_labjack.py. */

#include <errno.h>
#include <modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* FLOAT32 as LabJack's documents say: the more significant word first, big-endian. */
static void print_floats(const char *request, int count, const uint16_t *registers)
{
    printf("%s:", request);
    if (count < 0)
        printf(" %s", modbus_strerror(errno));
    for (int place = 0; place + 1 < count; place += 2)
        printf(" %.2f", modbus_get_float_abcd(registers + place));
    printf("\n");
}

/* modbus_set_float_abcd of libmodbus 3.1.6 swaps the bytes, which modbus_get_float_abcd does not. */
static void set_float(float value, uint16_t *registers)
{
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    registers[0] = bits >> 16;
    registers[1] = bits & 0xFFFF;
}

static void print_done(const char *request, int count)
{
    printf("%s: %s\n", request, count < 0 ? modbus_strerror(errno) : "done");
}

int main(int count, char **arguments)
{
    uint16_t registers[125] = {0};
    uint16_t range[2], settling[2];
    if (count != 2) {
        fprintf(stderr, "usage: %s PORT\n", arguments[0]);
        return 2;
    }
    modbus_t *link = modbus_new_tcp("127.0.0.1", atoi(arguments[1]));
    if (link == NULL || modbus_set_slave(link, 1) < 0 || modbus_connect(link) < 0) {
        fprintf(stderr, "cannot connect: %s\n", modbus_strerror(errno));
        return 1;
    }
    modbus_set_response_timeout(link, 2, 0);
    set_float(1.0f, range);
    set_float(100.0f, settling);
    print_floats("PRODUCT_ID", modbus_read_registers(link, 60000, 2, registers), registers);
    print_floats("AIN0 to AIN3, 03", modbus_read_registers(link, 0, 8, registers), registers);
    print_floats("AIN0 to AIN3, 04", modbus_read_input_registers(link, 0, 8, registers), registers);
    if (modbus_read_registers(link, 60028, 2, registers) == 2)
        printf("SERIAL_NUMBER: %u\n", MODBUS_GET_INT32_FROM_INT16(registers, 0));
    print_done("AIN_ALL_RANGE = 1", modbus_write_registers(link, 43900, 2, range));
    print_floats("AIN_ALL_RANGE", modbus_read_registers(link, 43900, 2, registers), registers);
    print_done("AIN_ALL_RESOLUTION_INDEX = 3", modbus_write_register(link, 43903, 3));
    print_done("AIN_ALL_SETTLING_US = 100", modbus_write_registers(link, 43904, 2, settling));
    if (modbus_read_registers(link, 43903, 1, registers) == 1)
        printf("AIN_ALL_RESOLUTION_INDEX: %u\n", registers[0]);
    print_floats("AIN0 to AIN3, 1 V", modbus_read_registers(link, 0, 8, registers), registers);
    print_done("AIN_ALL_RESOLUTION_INDEX = 9", modbus_write_register(link, 43903, 9));
    if (modbus_read_registers(link, 55000, 1, registers) == 1)
        printf("LAST_ERR_DETAIL: %u\n", registers[0]);
    print_done("AIN0 = 1", modbus_write_registers(link, 0, 2, range));
    print_floats("AIN14", modbus_read_registers(link, 28, 2, registers), registers);
    print_floats("half of AIN0", modbus_read_registers(link, 0, 1, registers), registers);
    print_done("coil", modbus_write_bit(link, 0, 1));
    print_done("function 23", modbus_write_and_read_registers(link, 43903, 1, registers, 0, 2, registers));
    modbus_close(link);
    modbus_free(link);
    return 0;
}
