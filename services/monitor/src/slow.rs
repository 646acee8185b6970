//! How long slow clients are waited for: that read no answer, that send a body bit by bit, that keep a connection for nothing.

use std::future::pending;
use std::io::{self, IoSlice};
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use axum::body::Bytes;
use hyper::body::{Body, Frame, SizeHint};
use hyper::rt::Executor;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::sync::watch;
use tokio::time::Sleep;

type BoxError = Box<dyn std::error::Error + Send + Sync>;

/// A stream that fails once nothing could be written for a time: its client does not read. By HTTP/2 a client that
/// takes nothing of one answer may read the rest of its connection, which is no failure of the stream:
/// [`AnswerExecutor`] ends such an answer.
pub(crate) struct TimedStream<S> {
    stream: S,
    time: Duration,
    /// Runs while nothing can be written.
    stuck: Option<Pin<Box<Sleep>>>,
}

impl<S> TimedStream<S> {
    pub fn new(stream: S, time: Duration) -> TimedStream<S> {
        TimedStream { stream, time, stuck: None }
    }

    fn timed<T>(&mut self, cx: &mut Context<'_>, written: Poll<io::Result<T>>) -> Poll<io::Result<T>> {
        if written.is_ready() {
            self.stuck = None;
            return written;
        }
        let time = self.time;
        let stuck = self.stuck.get_or_insert_with(|| Box::pin(tokio::time::sleep(time)));
        stuck.as_mut().poll(cx).map(|()| Err(io::ErrorKind::TimedOut.into()))
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for TimedStream<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        into: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(cx, into)
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for TimedStream<S> {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write(cx, bytes);
        self.timed(cx, written)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        parts: &[IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write_vectored(cx, parts);
        self.timed(cx, written)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        let flushed = Pin::new(&mut self.stream).poll_flush(cx);
        self.timed(cx, flushed)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        let shut = Pin::new(&mut self.stream).poll_shutdown(cx);
        self.timed(cx, shut)
    }
}

/// A request's body that fails where it is not there after a time.
pub(crate) struct TimedBody<B> {
    body: Pin<Box<B>>,
    end: Pin<Box<Sleep>>,
}

impl<B> TimedBody<B> {
    pub fn new(body: B, time: Duration) -> TimedBody<B> {
        TimedBody { body: Box::pin(body), end: Box::pin(tokio::time::sleep(time)) }
    }
}

impl<B> Body for TimedBody<B>
where
    B: Body,
    B::Error: Into<BoxError>,
{
    type Data = B::Data;
    type Error = BoxError;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<B::Data>, BoxError>>> {
        if let Poll::Ready(frame) = self.body.as_mut().poll_frame(cx) {
            return Poll::Ready(frame.map(|frame| frame.map_err(Into::into)));
        }
        let late = || BoxError::from("the request's body did not come in time");
        self.end.as_mut().poll(cx).map(|()| Some(Err(late())))
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

/// A request that is being answered; counted until it is dropped.
pub(crate) struct OpenRequest(Arc<watch::Sender<usize>>);

impl OpenRequest {
    pub fn new(open: &Arc<watch::Sender<usize>>) -> OpenRequest {
        open.send_modify(|count| *count += 1);
        OpenRequest(open.clone())
    }
}

impl Drop for OpenRequest {
    fn drop(&mut self) {
        self.0.send_modify(|count| *count -= 1);
    }
}

/// Bytes of an answer that are handed on at a time by HTTP/2: the client has to take them before the next ones are.
const MOST_PART: usize = 16 << 10;

/// Whether a part of an answer waits for its client. Every part that is taken is a change.
type WaitingPart = watch::Sender<bool>;

tokio::task_local! {
    /// Of the answer that the present task makes.
    static WAITING: Arc<WaitingPart>;
}

/// Runs the answers of a connection by HTTP/2, each in a task of its own. An answer of which its client takes nothing
/// for a time is given up, and its stream is reset; the other answers of the connection go on.
#[derive(Clone, Debug)]
pub(crate) struct AnswerExecutor {
    time: Duration,
}

impl AnswerExecutor {
    pub fn new(time: Duration) -> AnswerExecutor {
        AnswerExecutor { time }
    }
}

impl<F> Executor<F> for AnswerExecutor
where
    F: Future + Send + 'static,
    F::Output: Send + 'static,
{
    fn execute(&self, answer: F) {
        let waiting = Arc::new(WaitingPart::new(false));
        let not_taken = not_taken(waiting.subscribe(), self.time);
        tokio::spawn(WAITING.scope(waiting, async move {
            tokio::select! {
                _ = answer => {}
                () = not_taken => {}
            }
        }));
    }
}

/// Returns once a part has waited for its client for a time.
async fn not_taken(mut waiting: watch::Receiver<bool>, time: Duration) {
    loop {
        let waits = *waiting.borrow_and_update();
        let changed = match waits {
            true => match tokio::time::timeout(time, waiting.changed()).await {
                Ok(changed) => changed,
                Err(_) => return,
            },
            false => waiting.changed().await,
        };
        if changed.is_err() {
            return pending().await;
        }
    }
}

/// An answer's body, whose request is open until all of it is sent: a stream of events as long as somebody follows
/// it. It comes in parts of [`MOST_PART`] bytes at most, so that an answer waits here and not in the connection's
/// memory.
pub(crate) struct CountedBody {
    body: axum::body::Body,
    /// What came of the body and is not handed on yet.
    rest: Bytes,
    /// `None` outside of an [`AnswerExecutor`].
    waiting: Option<Arc<WaitingPart>>,
    _request: OpenRequest,
}

impl CountedBody {
    /// Has to be called in the answer's own task.
    pub fn new(body: axum::body::Body, request: OpenRequest) -> CountedBody {
        let waiting = WAITING.try_with(Arc::clone).ok();
        CountedBody { body, rest: Bytes::new(), waiting, _request: request }
    }

    fn waits(&self, waits: bool) {
        if let Some(waiting) = &self.waiting {
            waiting.send_replace(waits);
        }
    }
}

impl Body for CountedBody {
    type Data = <axum::body::Body as Body>::Data;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Self::Data>, axum::Error>>> {
        // Who wants the next part has taken the one before.
        self.waits(false);
        if self.rest.is_empty() {
            match ready!(Pin::new(&mut self.body).poll_frame(cx)) {
                Some(Ok(frame)) => match frame.into_data() {
                    Ok(data) => self.rest = data,
                    Err(trailers) => return Poll::Ready(Some(Ok(trailers))),
                },
                ended => return Poll::Ready(ended),
            }
        }
        let length = self.rest.len().min(MOST_PART);
        let part = self.rest.split_to(length);
        self.waits(true);
        Poll::Ready(Some(Ok(Frame::data(part))))
    }

    fn is_end_stream(&self) -> bool {
        self.rest.is_empty() && self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        let (body, rest) = (self.body.size_hint(), self.rest.len() as u64);
        let mut whole = SizeHint::new();
        whole.set_lower(body.lower() + rest);
        if let Some(upper) = body.upper() {
            whole.set_upper(upper + rest);
        }
        whole
    }
}

/// Returns once no request has been open for a time.
pub(crate) async fn idle(mut open: watch::Receiver<usize>, time: Duration) {
    loop {
        let busy = *open.borrow_and_update() > 0;
        let changed = open.changed();
        let over = match busy {
            true => changed.await.is_err(),
            false => !tokio::time::timeout(time, changed).await.is_ok_and(|changed| changed.is_ok()),
        };
        if over {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::future::poll_fn;
    use tokio::net::{TcpListener, TcpStream};

    /// The patience of these tests.
    const SHORT: Duration = Duration::from_millis(40);
    /// Longer than anything may take.
    const LONG: Duration = Duration::from_secs(60);

    fn wait<T>(work: impl Future<Output = T>) -> T {
        tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap().block_on(work)
    }

    #[test]
    fn a_client_that_does_not_read_is_dropped() {
        wait(async {
            let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
            let client = TcpStream::connect(listener.local_addr().unwrap()).await.unwrap();
            let (stream, _) = listener.accept().await.unwrap();
            let mut stream = TimedStream::new(stream, SHORT);
            let bytes = vec![0; 1 << 18];
            let failed = async {
                loop {
                    if let Err(e) = poll_fn(|cx| Pin::new(&mut stream).poll_write(cx, &bytes)).await {
                        return e;
                    }
                }
            };
            assert_eq!(tokio::time::timeout(LONG, failed).await.unwrap().kind(), io::ErrorKind::TimedOut);
            drop(client);
        });
    }

    /// A body of which nothing comes.
    struct EndlessBody;

    impl Body for EndlessBody {
        type Data = io::Cursor<Vec<u8>>;
        type Error = BoxError;

        fn poll_frame(
            self: Pin<&mut Self>,
            _: &mut Context<'_>,
        ) -> Poll<Option<Result<Frame<Self::Data>, BoxError>>> {
            Poll::Pending
        }
    }

    #[test]
    fn a_body_that_never_comes_is_not_waited_for() {
        wait(async {
            let mut body = TimedBody::new(EndlessBody, SHORT);
            let frame = tokio::time::timeout(LONG, poll_fn(|cx| Pin::new(&mut body).poll_frame(cx)));
            let error = frame.await.unwrap().unwrap().unwrap_err();
            assert!(error.to_string().contains("in time"), "{error}");
        });
    }

    #[test]
    fn an_answer_of_which_its_client_takes_nothing_is_given_up() {
        wait(async {
            let (open, mut requests) = watch::channel(0);
            let open = Arc::new(open);
            let bytes: Vec<u8> = (0..3 * MOST_PART + 7).map(|i| (i % 251) as u8).collect();
            // Takes a part, and the next one after a pause, as a connection does whose client opens its window.
            let answer = |pause: Duration, time: Duration| {
                let (request, bytes) = (OpenRequest::new(&open), bytes.clone());
                let (done, read) = tokio::sync::oneshot::channel();
                let taking = async move {
                    let mut body = CountedBody::new(bytes.into(), request);
                    assert_eq!(body.size_hint().exact(), Some(3 * MOST_PART as u64 + 7));
                    let mut taken: Vec<Bytes> = Vec::new();
                    while let Some(part) = poll_fn(|cx| Pin::new(&mut body).poll_frame(cx)).await {
                        taken.push(part.unwrap().into_data().unwrap());
                        tokio::time::sleep(pause).await;
                    }
                    assert!(body.is_end_stream());
                    let _ = done.send(taken);
                };
                AnswerExecutor::new(time).execute(taking);
                read
            };
            // In all it takes longer than a part may.
            let slow = answer(7 * SHORT, 25 * SHORT);
            let taken = tokio::time::timeout(LONG, slow).await.unwrap().unwrap();
            assert!(taken.len() == 4 && taken.iter().all(|part| part.len() <= MOST_PART));
            assert!(taken.iter().flatten().eq(&bytes));
            let stuck = answer(2 * LONG, SHORT);
            assert!(tokio::time::timeout(LONG, stuck).await.unwrap().is_err(), "its task has ended");
            let over = requests.wait_for(|open| *open == 0);
            assert!(tokio::time::timeout(LONG, over).await.unwrap().is_ok());
        });
    }

    #[test]
    fn an_answer_that_has_nothing_to_send_is_waited_for() {
        wait(async {
            let waiting = WaitingPart::new(false);
            let not_taken = not_taken(waiting.subscribe(), SHORT);
            assert!(tokio::time::timeout(3 * SHORT, not_taken).await.is_err());
        });
    }

    #[test]
    fn a_connection_is_idle_once_its_last_request_is_over() {
        wait(async {
            let (open, requests) = watch::channel(0);
            let open = Arc::new(open);
            let followed = OpenRequest::new(&open);
            // Events are followed for as long as somebody wants them.
            assert!(tokio::time::timeout(3 * SHORT, idle(requests.clone(), SHORT)).await.is_err());
            drop(followed);
            assert!(tokio::time::timeout(LONG, idle(requests, SHORT)).await.is_ok());
        });
    }
}
