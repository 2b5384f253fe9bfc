"""The client for programs without asyncio: one thread receives, another one calls back."""

import asyncio
import logging
import threading
from collections.abc import Callable, Coroutine, Sequence
from concurrent.futures import CancelledError, Future
from functools import partial
from typing import Any, Literal, Self, TypeVar

from skin_host.client.heard import Described, Health
from skin_host.client.presence import STALE_S, Contact
from skin_host.client.session import SkinClient
from skin_host.client.streams import ENDED, Stream
from skin_host.clock import SYSTEM
from skin_host.errors import RequestError, SkinError
from skin_host.fingertip.events import Over, Slip
from skin_host.mqtt.address import Broker
from skin_host.mqtt.info import NodeInfo
from skin_host.mqtt.messages import Frame
from skin_host.processing.events import Touch
from skin_host.tasks import cancel

T = TypeVar("T")
_log = logging.getLogger(__name__)


class SkinCallbacks:
    """Calls functions with received messages. Takes the arguments of `SkinClient`.

        with SkinCallbacks("mqtt://localhost", robot="demo") as skin:
            skin.on_touch(lambda touch: print(touch.part, touch.event))
            input("Enter ends it")

    The functions run one after the other in one thread, which is not the caller's: data that they
    share with it needs a lock. While one of them runs the others wait, and messages are received:
    then each function gets its next one in turn, so that a slow one holds another up only once. An
    exception in one of them is logged, and the next ones are called. In them `present` and `parts`
    can be asked, and nothing that waits: `ready`, `info`, `command` and `on_...` raise a
    RequestError there. Leaving the block waits for the function that runs.

    Raises (on entering): see `SkinClient`.
    Raises (in use):
        RequestError: outside of the `with` block nothing is received.
    Raises (on leaving):
        RequestError: the robot has no part of the name that an `on_...` was given. That is logged
            when it is known.
        BrokerError: a broker did not let us subscribe to what an `on_...` needs. That is logged,
            too.
    """

    def __init__(
        self,
        broker: str | Broker | Sequence[str | Broker] = "mqtt://localhost",
        *,
        robot: str | None = None,
        base: str | None = None,
        protocol: Literal["5", "3.1.1"] = "5",
        patience_s: float = 10.0,
        stale_s: float = STALE_S,
    ) -> None:
        self._make = partial(
            SkinClient,
            broker,
            robot=robot,
            base=base,
            protocol=protocol,
            patience_s=patience_s,
            stale_s=stale_s,
        )
        self._ready: Future[tuple[SkinClient, asyncio.AbstractEventLoop]] = Future()
        self._end = asyncio.Event()
        #: Held while something is given to the thread, which takes nothing more once it is over.
        self._giving = threading.Lock()
        self._is_over = False
        self._calls: set[asyncio.Task[None]] = set()
        #: By stream: that the robot has no part of its name, or the broker refuses its topic.
        self._failures: dict[Stream[Any], SkinError] = {}
        self._thread = threading.Thread(
            target=lambda: asyncio.run(self._serve()), name="skin client", daemon=True
        )
        #: In which the functions are called, since the first call.
        self._calling: threading.Thread | None = None

    def on_touch(self, call: Callable[[Touch], object], part: str | None = None) -> None:
        """Call with each touch event of a part, or of all."""
        self._on(lambda skin: skin.touches(part), call)

    def on_slip(self, call: Callable[[Slip], object], part: str | None = None) -> None:
        """Call when a fingertip, or any, begins or ends to slip."""
        self._on(lambda skin: skin.slips(part), call)

    def on_over(self, call: Callable[[Over], object], part: str | None = None) -> None:
        """Call when a fingertip, or any, begins or ends to press too hard."""
        self._on(lambda skin: skin.overs(part), call)

    def on_frame(self, call: Callable[[Frame], object], part: str | None = None) -> None:
        """Call with each frame of a part, or of all."""
        self._on(lambda skin: skin.frames(part), call)

    def on_contact(self, call: Callable[[Contact], object], part: str | None = None) -> None:
        """Call when a part's contact state changes; first with the present state."""
        self._on(lambda skin: skin.contacts(part), call)

    def on_unknown(self, call: Callable[[Contact], object], part: str | None = None) -> None:
        """Call when a part's contact state becomes unknown; see `Contact.why`."""

        def call_unknown(contact: Contact) -> None:
            if not contact.known:
                call(contact)

        self._on(lambda skin: skin.contacts(part), call_unknown)

    def present(self, part: str | None = None) -> list[Touch]:
        """See `SkinClient.present`."""
        return self._ask(lambda skin: skin.present(part))

    def on_health(self, call: Callable[[Health], object], part: str | None = None) -> None:
        """Call with each record of a part's health, or of all parts' health."""
        self._on(lambda skin: skin.health(part), call)

    def on_info(self, call: Callable[[Described], object], part: str | None = None) -> None:
        """Call with the description of a part, or of all, and with each that follows."""
        self._on(lambda skin: skin.infos(part), call)

    def parts(self) -> dict[str, Described]:
        """See `SkinClient.parts`."""
        return self._ask(SkinClient.parts)

    def ready(self) -> None:
        """Wait until what follows reaches the functions: the broker knows what they ask for."""
        self._wait_for(SkinClient.ready)

    def info(self, timeout_s: float = 5.0) -> dict[str, NodeInfo]:
        return self._wait_for(lambda skin: skin.info(timeout_s))

    def command(
        self,
        name: str,
        *,
        node: str | None = None,
        timeout_s: float | None = None,
        **arguments: Any,
    ) -> dict[str, Any]:
        """See `SkinClient.command`."""
        return self._wait_for(
            lambda skin: skin.command(name, node=node, timeout_s=timeout_s, **arguments)
        )

    def __enter__(self) -> Self:
        if self._thread.ident is not None:
            raise RequestError("these callbacks were entered before: make other ones")
        self._thread.start()
        self._skin, self._loop = self._ready.result()
        return self

    def __exit__(self, kind: type[BaseException] | None = None, *_: object) -> None:
        self._refuse_callback()
        self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join()
        if kind is None and self._failures:
            raise next(iter(self._failures.values()))

    async def _serve(self) -> None:
        try:
            async with self._make() as skin:
                self._caller = SYSTEM.executor("skin callbacks")
                self._ready.set_result((skin, asyncio.get_running_loop()))
                await self._end.wait()
                await cancel(*self._calls)
                # The function that runs, and may ask, is the last.
                await asyncio.wrap_future(self._caller.submit(self._caller.close))
        except BaseException as error:
            if self._ready.done():
                raise
            self._ready.set_exception(error)
        finally:
            with self._giving:
                self._is_over = True
            # What was given before becomes a task, which is cancelled: nobody waits for ever.
            await asyncio.sleep(0.0)

    def _on(
        self, open_stream: Callable[[SkinClient], Stream[T]], call: Callable[[T], object]
    ) -> None:
        async def begin(skin: SkinClient) -> None:
            # The stream is opened here, in its own thread, before `on_...` returns.
            self._calls.add(asyncio.create_task(self._call_with_each(open_stream(skin), call)))

        self._wait_for(begin)

    async def _call_with_each(self, stream: Stream[T], call: Callable[[T], object]) -> None:
        while True:
            try:
                item = await anext(stream)
            except StopAsyncIteration:
                return
            except SkinError as error:
                _log.error("%s", error)
                self._failures.setdefault(stream, error)
                continue
            if isinstance(self._failures.get(stream), RequestError):
                del self._failures[stream]
            await asyncio.wrap_future(self._caller.submit(self._call, call, item))

    def _call(self, call: Callable[[T], object], item: T) -> None:
        self._calling = threading.current_thread()
        try:
            call(item)
        except BaseException:  # SystemExit would end the thread, and what the others receive
            _log.exception("a callback failed")

    def _ask(self, question: Callable[[SkinClient], T]) -> T:
        """Ask for what the client knows; that can be asked in a callback, too."""

        async def found(skin: SkinClient) -> T:
            return question(skin)

        return self._result_of(found)

    def _wait_for(self, work: Callable[[SkinClient], Coroutine[Any, Any, T]]) -> T:
        self._refuse_callback()
        return self._result_of(work)

    def _refuse_callback(self) -> None:
        if threading.current_thread() is self._calling:
            raise RequestError("a callback cannot wait for messages; ask in another thread")

    def _result_of(self, work: Callable[[SkinClient], Coroutine[Any, Any, T]]) -> T:
        if self._thread.ident is None:
            raise RequestError("these callbacks were not entered: use them in their `with` block")
        ended = RequestError(ENDED)
        with self._giving:
            if self._is_over:
                raise ended
            asked = asyncio.run_coroutine_threadsafe(work(self._skin), self._loop)
        try:
            return asked.result()
        except CancelledError:
            raise ended from None
