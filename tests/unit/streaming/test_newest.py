"""One value between two threads: the newest one, or every one if the sender waits."""

import threading

import pytest

from geodiff_plugin.streaming.newest import Newest


def in_thread(work) -> threading.Thread:
    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    return thread


def test_the_receiver_gets_the_newest_value_once():
    slot = Newest[int]()
    assert slot.put(1) and slot.put(2)
    assert slot.take() == 2
    thread = in_thread(lambda: slot.put(3))
    assert slot.take() == 3
    thread.join(5)


def test_a_sender_that_waits_goes_on_when_its_value_was_taken():
    slot, put = Newest[int](waits=True), []

    def send():
        put.extend(map(slot.put, range(3)))

    thread = in_thread(send)
    taken = []
    for value in range(3):
        assert len(put) <= value  # no value was put before the last one was taken
        taken.append(slot.take())
    thread.join(5)
    assert taken == [0, 1, 2] and put == [True] * 3


def test_equal_values_are_different_ones():
    slot, done = Newest[int](waits=True), threading.Event()
    thread = in_thread(lambda: (slot.put(7), slot.put(7), done.set()))
    assert slot.take() == 7 and not done.wait(0.05)
    assert slot.take() == 7
    thread.join(5)
    assert done.is_set()


def test_the_last_value_can_be_taken_after_the_end():
    slot = Newest[str]()
    slot.put("last")
    slot.close()
    assert slot.take() == "last" and slot.take() is None and slot.take() is None
    assert not slot.put("late")


def test_an_error_is_raised_after_the_last_value():
    slot = Newest[str]()
    slot.put("last")
    slot.close(OSError("unplugged"))
    slot.close(OSError("again"))
    assert slot.take() == "last"
    with pytest.raises(OSError, match="unplugged"):
        slot.take()


@pytest.mark.parametrize("waiting", ["put", "take"])
def test_the_end_frees_a_waiting_thread(waiting):
    slot, answers = Newest[int](waits=True), []
    thread = in_thread(lambda: answers.append(slot.put(1) if waiting == "put" else slot.take()))
    slot.close()
    thread.join(5)
    assert not thread.is_alive() and answers == [False if waiting == "put" else None]


@pytest.mark.parametrize("taken", [False, True])
def test_the_end_shows_a_sender_whether_its_value_was_taken(taken, monkeypatch):
    slot = Newest[int](waits=True)

    def wait_for(condition):
        if not condition():  # the sender waits: what another thread does meanwhile
            assert not taken or slot.take() == 1
            slot.close()

    monkeypatch.setattr(slot._changed, "wait_for", wait_for)
    assert slot.put(1) == taken
    assert slot.take() is None
