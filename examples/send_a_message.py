"""What travels: tracked boxes to bytes and back, 32 bytes an object."""

from cobevglue.messages import MessageError, ObjectMessage, decode, encode
from cobevglue.simulation import Junction
from cobevglue.tracking import Sort


def main() -> None:
    frame = Junction(seed=1)[0]
    boxes = Sort().update(frame.agents["car2"].boxes)
    data = encode(ObjectMessage(agent_id="car2", time=frame.time, frame=frame.index, boxes=boxes))
    received = decode(data)
    print(f"{len(boxes)} objects in {len(data)} bytes; {received.agent_id} sent {len(received.boxes)}")

    damaged = bytearray(data)
    damaged[100] ^= 1
    try:
        decode(damaged)
    except MessageError as error:
        print("a damaged message is noticed:", error)


if __name__ == "__main__":
    main()
