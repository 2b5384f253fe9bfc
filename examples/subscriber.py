"""A plain subscriber: paho alone, nothing of skin-host. `python examples/subscriber.py [PORT]`."""

import json
import sys

import paho.mqtt.client as mqtt


def on_connect(client: mqtt.Client, *_: object) -> None:
    """Subscribe again after every connection."""
    client.subscribe("skin/+/+/touch", qos=1)


def on_message(_client: mqtt.Client, _data: object, message: mqtt.MQTTMessage) -> None:
    """Print who is touched where, and how hard."""
    touch = json.loads(message.payload)
    print(touch["part"], touch["event"], touch["id"], f"{touch['force_n']:.2f} N", flush=True)


client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2, protocol=mqtt.MQTTv5)
client.on_connect = on_connect
client.on_message = on_message
given = sys.argv[1] if len(sys.argv) > 1 else "1883"
if not (given.isdecimal() and 0 < int(given) < 65536):
    sys.exit(f"{given}: wanted the port of a broker, a number from 1 to 65535")
try:
    client.connect("localhost", int(given))
    client.loop_forever()
except OSError as error:
    sys.exit(f"localhost:{given}: {error}; is a broker running there?")
except KeyboardInterrupt:
    client.disconnect()
