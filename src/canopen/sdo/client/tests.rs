//! The client against the answer frames of a node.

use super::*;
use crate::canopen::sdo::SdoValue;
use crate::units::at_ms;

const NODE: NodeId = NodeId::new(5).unwrap();
const VENDOR: ObjectAddress = ObjectAddress::new(0x1018, 1);
const STATUS: ObjectAddress = ObjectAddress::new(0x6041, 0);
const TIMEOUT: Duration = Duration::from_millis(150);

fn started(request: SdoRequest) -> SdoClient {
    let mut client = SdoClient::new(NODE, TIMEOUT);
    client.start(at_ms(0), request);
    client
}

fn answer(client: &mut SdoClient, bytes: [u8; 8]) {
    client.handle_frame(at_ms(1), &Frame::new(0x585, &bytes));
}

fn sent(client: &mut SdoClient) -> String {
    std::iter::from_fn(|| client.poll_transmit())
        .map(|frame| frame.to_string())
        .collect::<Vec<_>>()
        .join(" ")
}

#[test]
fn expedited_upload() {
    let mut client = started(SdoRequest::Upload(VENDOR));
    assert_eq!(sent(&mut client), "605#4018100100000000");
    answer(&mut client, [0x43, 0x18, 0x10, 0x01, 0xfb, 0, 0, 0]);
    assert_eq!(client.poll_result(), Some(Ok(SdoReply::Uploaded(0xfb_u32.into()))));
    assert_eq!(client.poll_result(), None);
}

/// Some servers leave the object out of their aborts.
#[test]
fn an_abort_without_an_object_ends_the_transfer_under_way() {
    let mut client = started(SdoRequest::Upload(VENDOR));
    answer(&mut client, [0x80, 0, 0, 0, 0, 0, 0x02, 0x06]);
    let error = client.poll_result().unwrap().unwrap_err();
    assert_eq!(error, SdoError::Aborted(AbortCode::NO_SUCH_OBJECT));
    assert_eq!(
        sent(&mut client),
        "605#4018100100000000",
        "the request alone: an abort is not answered"
    );
}

/// Such an abort may belong to the transfer that timed out.
#[test]
fn a_late_abort_without_an_object_does_not_end_the_next_transfer() {
    let mut client = started(SdoRequest::Upload(VENDOR));
    client.handle_timeout(at_ms(150));
    client.poll_result();
    client.start(at_ms(150), SdoRequest::Upload(STATUS));
    answer(&mut client, [0x80, 0, 0, 0, 0, 0, 0x02, 0x06]);
    assert_eq!(client.poll_result(), None);
    answer(&mut client, [0x4f, 0x01, 0x10, 0, 0, 0, 0, 0]);
    answer(&mut client, [0x4b, 0x41, 0x60, 0, 0x37, 0x02, 0, 0]);
    assert_eq!(client.poll_result(), Some(Ok(SdoReply::Uploaded(0x0237_u16.into()))));
}

#[test]
fn expedited_download() {
    let object = ObjectAddress::new(0x1017, 0);
    let mut client = started(SdoRequest::Download(object, SdoValue::from(1000_u16)));
    assert_eq!(sent(&mut client), "605#2B171000E8030000");
    answer(&mut client, [0x60, 0x17, 0x10, 0, 0, 0, 0, 0]);
    assert_eq!(client.poll_result(), Some(Ok(SdoReply::Downloaded)));
}

#[test]
fn a_refused_request_ends_with_the_abort_code() {
    let mut client = started(SdoRequest::Upload(STATUS));
    sent(&mut client);
    answer(&mut client, [0x80, 0x41, 0x60, 0x00, 0x00, 0x00, 0x02, 0x06]);
    let error = client.poll_result().unwrap().unwrap_err();
    assert_eq!(error, SdoError::Aborted(AbortCode::NO_SUCH_OBJECT));
    assert_eq!(error.to_string(), "refused with SDO abort 0x06020000 object does not exist");
    assert_eq!(sent(&mut client), "", "an abort is not answered");
}

#[test]
fn a_request_without_an_answer_times_out_with_an_abort_to_the_node() {
    let mut client = started(SdoRequest::Upload(STATUS));
    sent(&mut client);
    assert_eq!(client.deadline(), at_ms(150));
    client.handle_timeout(at_ms(149));
    assert_eq!(client.poll_result(), None);
    client.handle_timeout(at_ms(150));
    let error = client.poll_result().unwrap().unwrap_err();
    assert_eq!(error.to_string(), "no SDO reply within 150 ms");
    assert_eq!(sent(&mut client), "605#8041600000000405");
    assert_eq!(client.deadline(), Time::NEVER);
}

#[test]
fn an_answer_about_another_object_is_ignored() {
    let mut client = started(SdoRequest::Upload(STATUS));
    sent(&mut client);
    answer(&mut client, [0x43, 0x18, 0x10, 0x01, 0xfb, 0, 0, 0]);
    answer(&mut client, [0x80, 0x18, 0x10, 0x01, 0x00, 0x00, 0x02, 0x06]);
    answer(&mut client, *b"\x000123456");
    answer(&mut client, [0x60, 0x41, 0x60, 0x00, 0, 0, 0, 0]);
    assert_eq!(client.poll_result(), None);
    assert_eq!(client.deadline(), at_ms(150), "a stale answer does not prolong the wait");
    answer(&mut client, [0x4b, 0x41, 0x60, 0x00, 0x37, 0x02, 0, 0]);
    assert_eq!(client.poll_result(), Some(Ok(SdoReply::Uploaded(0x0237_u16.into()))));
}

/// After a timeout the client first reads the error register as a fence. An answer before that of the fence is
/// old, even if it is about the object that is requested again.
#[test]
fn a_late_answer_is_not_taken_for_the_next_request() {
    let mut client = started(SdoRequest::Upload(STATUS));
    client.handle_timeout(at_ms(150));
    sent(&mut client);
    client.start(at_ms(151), SdoRequest::Upload(STATUS));
    assert_eq!(sent(&mut client), "605#4001100000000000");
    answer(&mut client, [0x4b, 0x41, 0x60, 0x00, 0x11, 0x11, 0, 0]);
    assert_eq!((client.poll_result(), sent(&mut client)), (None, String::new()));
    answer(&mut client, [0x4f, 0x01, 0x10, 0x00, 0, 0, 0, 0]);
    assert_eq!(sent(&mut client), "605#4041600000000000");
    answer(&mut client, [0x4b, 0x41, 0x60, 0x00, 0x37, 0x02, 0, 0]);
    assert_eq!(client.poll_result(), Some(Ok(SdoReply::Uploaded(0x0237_u16.into()))));
    client.start(at_ms(200), SdoRequest::Upload(STATUS));
    assert_eq!(sent(&mut client), "605#4041600000000000", "no fence: no old answer is outstanding");
}

/// The fence is another object than the requested one.
#[test]
fn a_refused_fence_counts_as_answered() {
    let register = ObjectAddress::new(0x1001, 0);
    let mut client = started(SdoRequest::Upload(register));
    client.handle_timeout(at_ms(150));
    sent(&mut client);
    client.start(at_ms(151), SdoRequest::Upload(register));
    assert_eq!(sent(&mut client), "605#4000100000000000");
    answer(&mut client, [0x80, 0x00, 0x10, 0x00, 0x00, 0x00, 0x02, 0x06]);
    assert_eq!(sent(&mut client), "605#4001100000000000");
}

#[test]
fn a_fence_without_an_answer_times_out_as_the_request() {
    let mut client = started(SdoRequest::Upload(STATUS));
    client.handle_timeout(at_ms(150));
    client.start(at_ms(151), SdoRequest::Upload(VENDOR));
    client.handle_timeout(at_ms(301));
    let error = client.poll_result().unwrap().unwrap_err();
    assert_eq!(error, SdoError::Timeout(TIMEOUT));
}

#[test]
fn a_reserved_command_or_a_block_transfer_is_an_error() {
    for command in [0xa4, 0xc6, 0xe2] {
        let mut client = started(SdoRequest::Upload(VENDOR));
        sent(&mut client);
        answer(&mut client, [command, 0x18, 0x10, 0x01, 0, 0, 0, 0]);
        let error = client.poll_result().unwrap().unwrap_err();
        assert_eq!(error, SdoError::UnexpectedCommand(command));
        assert_eq!(sent(&mut client), "605#8018100101000405");
    }
}

/// The bench reads no object of more than 4 bytes.
#[test]
fn a_value_in_segments_is_an_error() {
    let mut client = started(SdoRequest::Upload(VENDOR));
    sent(&mut client);
    answer(&mut client, [0x41, 0x08, 0x10, 0, 26, 0, 0, 0]);
    assert_eq!(client.poll_result(), None, "an answer about another object");
    answer(&mut client, [0x41, 0x18, 0x10, 0x01, 26, 0, 0, 0]);
    assert_eq!(client.poll_result(), Some(Err(SdoError::TooLong)));
    assert_eq!(sent(&mut client), "605#8018100105000405");
}

#[test]
fn a_new_transfer_ends_the_one_under_way() {
    let mut client = started(SdoRequest::Upload(VENDOR));
    client.start(at_ms(1), SdoRequest::Upload(STATUS));
    assert_eq!(client.poll_result(), None);
    let frames = "605#4018100100000000 605#8018100100000008 605#4001100000000000";
    assert_eq!(sent(&mut client), frames);
    client.cancel();
    assert_eq!(client.poll_result(), None);
    assert_eq!(client.deadline(), Time::NEVER);
}

const VENDOR_IS_FB: [u8; 8] = [0x43, 0x18, 0x10, 0x01, 0xfb, 0, 0, 0];
const REFUSED: [u8; 8] = [0x80, 0x18, 0x10, 0x01, 0, 0, 0x02, 0x06];

/// Two nodes have the same number, and both answer.
#[test]
fn a_second_answer_to_a_request_is_counted() {
    for second in [VENDOR_IS_FB, REFUSED] {
        let mut client = started(SdoRequest::Upload(VENDOR));
        answer(&mut client, VENDOR_IS_FB);
        assert_eq!((client.answers(), client.extra_answers()), (1, 0));
        answer(&mut client, second);
        assert_eq!((client.answers(), client.extra_answers()), (1, 1), "between two requests");
        client.start(at_ms(2), SdoRequest::Upload(STATUS));
        answer(&mut client, second);
        assert_eq!(client.extra_answers(), 2, "during the next request");
        answer(&mut client, [0x4b, 0x41, 0x60, 0, 0x37, 0x02, 0, 0]);
        answer(&mut client, VENDOR_IS_FB);
        assert_eq!((client.answers(), client.extra_answers()), (2, 3), "of an older request");
        for k in 3..10 {
            client.start(at_ms(k), SdoRequest::Upload(STATUS));
            answer(&mut client, [0x4b, 0x41, 0x60, 0, 0x37, 0x02, 0, 0]);
        }
        answer(&mut client, VENDOR_IS_FB);
        assert_eq!((client.answers(), client.extra_answers()), (9, 3), "of one too old");
    }
    // What was written is read back.
    let object = ObjectAddress::new(0x1017, 0);
    let mut client = started(SdoRequest::Download(object, SdoValue::from(1000_u16)));
    answer(&mut client, [0x60, 0x17, 0x10, 0, 0, 0, 0, 0]);
    client.start(at_ms(2), SdoRequest::Upload(object));
    answer(&mut client, [0x60, 0x17, 0x10, 0, 0, 0, 0, 0]);
    assert_eq!(client.extra_answers(), 1);
    answer(&mut client, [0x4b, 0x17, 0x10, 0, 0xe8, 3, 0, 0]);
    assert_eq!((client.answers(), client.extra_answers()), (2, 1));
}

/// The node answers the request and its repetition. The second answer comes before or after that to the fence.
#[test]
fn the_answers_to_a_request_that_was_repeated_after_a_timeout_are_not_counted() {
    let mut client = started(SdoRequest::Upload(STATUS));
    answer(&mut client, [0x4b, 0x41, 0x60, 0, 0x37, 0x02, 0, 0]);
    client.start(at_ms(10), SdoRequest::Upload(VENDOR));
    client.handle_timeout(at_ms(160));
    answer(&mut client, VENDOR_IS_FB);
    client.start(at_ms(161), SdoRequest::Upload(VENDOR));
    answer(&mut client, VENDOR_IS_FB);
    answer(&mut client, [0x4f, 0x01, 0x10, 0, 0, 0, 0, 0]);
    answer(&mut client, VENDOR_IS_FB);
    assert_eq!((client.answers(), client.extra_answers()), (2, 0));
    answer(&mut client, VENDOR_IS_FB);
    assert_eq!(client.extra_answers(), 1, "no old answer comes after that to the fence");
}

#[test]
fn extra_answers_prove_nothing_when_another_client_asks_the_node() {
    let mut client = started(SdoRequest::Upload(VENDOR));
    let request = |id: u16| Frame::new(id, &[0x40, 0x18, 0x10, 0x01, 0, 0, 0, 0]);
    client.handle_frame(at_ms(1), &request(0x606));
    answer(&mut client, VENDOR_IS_FB);
    answer(&mut client, VENDOR_IS_FB);
    assert_eq!(client.extra_answers(), 1, "that request was to another node");
    client.handle_frame(at_ms(1), &request(0x605));
    assert_eq!(client.extra_answers(), 0);
}
