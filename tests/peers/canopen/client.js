// npm canopen as a master of the mock drive: `node client.js PORT` prints what it saw as one JSON object.
'use strict';

const net = require('net');
const { Device, DataType } = require('canopen');

const DRIVE = 1;
const PATIENCE_MS = 5000;

/** SLCAN over TCP, as the messages that npm canopen sends and receives. */
function connect(port, device) {
    const socket = net.connect(port, '127.0.0.1');
    socket.setNoDelay(true);
    socket.write('S8\rO\r');
    let unfinished = '';
    socket.on('data', (bytes) => {
        const lines = (unfinished + bytes.toString('ascii')).split(/[\r\x07]/);
        unfinished = lines.pop();
        for (const line of lines.filter((one) => one.startsWith('t'))) {
            device.receive({
                id: parseInt(line.slice(1, 4), 16),
                data: Buffer.from(line.slice(5), 'hex'),
            });
        }
    });
    device.addListener('message', ({ id, data }) => {
        const digits = (data || Buffer.alloc(0)).toString('hex');
        socket.write(`t${id.toString(16).padStart(3, '0')}${digits.length / 2}${digits}\r`);
    });
    return socket;
}

async function main(port) {
    const device = new Device({ id: 0x7e });
    const socket = connect(port, device);
    const saw = { heartbeats: [], emergencies: [] };
    const { eds } = device;
    eds.addSdoClientParameter(DRIVE, 0x600 | DRIVE, 0x580 | DRIVE);
    eds.addEmcyConsumer(0x80 | DRIVE);
    eds.addHeartbeatConsumer(DRIVE, 1000);
    eds.setSyncCobId(0x80);
    eds.setSyncGenerationEnable(true);
    const counts = eds.addEntry(0x2001, { parameterName: 'counts', dataType: DataType.INTEGER32 });
    eds.addReceivePdo({ cobId: 0x180 | DRIVE, dataObjects: [counts] });
    const target = eds.addEntry(0x2002, { parameterName: 'target', dataType: DataType.INTEGER32 });
    eds.addTransmitPdo({ cobId: 0x200 | DRIVE, transmissionType: 254, dataObjects: [target] });
    device.nmt.on('heartbeat', ({ deviceId, state }) => saw.heartbeats.push([deviceId, state]));
    device.emcy.on('emergency', ({ em }) => saw.emergencies.push(em.code));
    device.start();
    device.nmt.startNode();

    const read = (index, subIndex, dataType) =>
        device.sdo.upload({ serverId: DRIVE, index, subIndex, dataType });
    const write = (index, subIndex, dataType, data) =>
        device.sdo.download({ serverId: DRIVE, index, subIndex, dataType, data });
    const u8 = (index, subIndex, value) => write(index, subIndex, DataType.UNSIGNED8, value);
    const u16 = (index, subIndex, value) => write(index, subIndex, DataType.UNSIGNED16, value);
    const u32 = (index, subIndex, value) => write(index, subIndex, DataType.UNSIGNED32, value);

    saw.name = await read(0x1008, 0, DataType.VISIBLE_STRING);
    saw.serial = await read(0x1018, 4, DataType.UNSIGNED32);
    saw.abort = await read(0x2099, 0, DataType.UNSIGNED32).catch((error) => error.code);
    await u16(0x1017, 0, 20);

    await u8(0x1600, 0, 0);
    await u32(0x1600, 1, 0x60ff0020);
    await u8(0x1600, 0, 1);
    await u8(0x1400, 2, 1);
    await u32(0x1400, 1, 0x200 | DRIVE);
    await u8(0x1a00, 0, 0);
    await u32(0x1a00, 1, 0x60640020);
    await u8(0x1a00, 0, 1);
    await u8(0x1800, 2, 1);
    await u32(0x1800, 1, 0x180 | DRIVE);
    device.nmt.startNode(DRIVE);

    await write(0x6060, 0, DataType.INTEGER8, 9);
    saw.statuswords = [];
    for (const controlword of [0x06, 0x07, 0x0f]) {
        await u16(0x6040, 0, controlword);
        saw.statuswords.push(await read(0x6041, 0, DataType.UNSIGNED16));
    }
    const pdo = new Promise((resolve) => device.pdo.once('pdo', resolve));
    device.setValue(0x2002, 60);
    device.sync.write();
    await pdo;
    saw.counts = device.getValue(0x2001);
    saw.target = await read(0x60ff, 0, DataType.INTEGER32);

    const code = new Promise((resolve) => device.emcy.once('emergency', resolve));
    await u32(0x1016, 1, (0x7d << 16) | 20);
    // A heartbeat, once and never again: the drive shall miss it.
    device.emit('message', { id: 0x700 | 0x7d, data: Buffer.from([5]) });
    await code;
    console.log(JSON.stringify(saw));
    device.stop();
    socket.end();
}

setTimeout(() => {
    console.error('nothing more came');
    process.exit(2);
}, PATIENCE_MS).unref();
main(Number(process.argv[2])).catch((error) => {
    console.error(error);
    process.exit(1);
});
